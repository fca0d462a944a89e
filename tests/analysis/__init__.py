"""Analysis is true of arrays whose truth is known."""
