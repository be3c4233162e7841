"""Learn surfels, light, exposures and poses: what is done in each iteration, or now and then."""
