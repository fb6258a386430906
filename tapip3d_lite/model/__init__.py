"""The tracker, one idea a file; read in the order config, frames, spaces, encoder, cloud, neighbors, contexts, updater, tracker."""
