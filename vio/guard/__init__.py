"""Checks between readers and estimator, the same for every front end and for live use.

`guarded` puts them before and behind a front end. A check of the images is a class of `ImageCheck`
in a file of its own, and an entry in `vio.guard.guarded.image_checks`. It removes information, or
puts back in order what was exchanged; it never guesses.
"""
