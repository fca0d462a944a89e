"""Chunks: about 1,024 rows of one signal of a run, compressed, with what they come to beside."""
