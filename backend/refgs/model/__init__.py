"""What is learned: the surfels and the light."""
