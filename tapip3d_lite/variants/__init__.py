"""Parts of the other systems that the paper compares: image spaces, fixed windows, planes, correlations, P2N."""
