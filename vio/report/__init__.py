"""A page about one or several finished runs, to be opened in a browser without a network."""
