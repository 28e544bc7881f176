"""What is done beside and after a run: calibration measured, a run checked, refined and exported, with COLMAP's help.

The commands of the same names parse, call these functions and print. Everything here may know readers, mapping and
COLMAP; nothing but the command line knows these.
"""
