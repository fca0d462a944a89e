"""What was published: names, kinds and units of signals, and the registry of them."""
