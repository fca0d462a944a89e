"""Whether the checks of a run are right: labelled runs, healthy and with one fault each."""
