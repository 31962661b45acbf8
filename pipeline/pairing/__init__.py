"""Which pairs of frames can give depth: candidates from a spatial index, and the rules that reject them."""
