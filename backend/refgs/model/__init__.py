"""Define what training learns: the surfels, and the light of the environment."""
