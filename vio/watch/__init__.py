"""What looks on at a run and changes nothing: is the IMU what it claims to be, and is the estimate still sane?

Nothing here knows a reader, a front end or a filter.
"""
