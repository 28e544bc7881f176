"""A map's place on the earth: WGS84 positions, and their fusion with a trajectory."""
