"""Dense reconstruction: depth of rectified pairs, its fusion into a signed distance function,
and the surface of it.
"""
