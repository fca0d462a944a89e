"""One module for each question that tools, command line, plots and tests ask."""
