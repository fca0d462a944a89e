"""Situations that users of robots met, as recordings, with the answer that an expert would give."""
