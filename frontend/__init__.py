"""Images in, tracked stereo observations out. Knows OpenCV; nothing in `vio`'s filters imports it."""
