"""The paper, top to bottom: config, frames, spaces, encoder, cloud, neighbors, blocks, n2n, updater, windows, tracker."""
