"""One module per family of lines."""
