"""Learn surfels, light, exposures and poses. Some modules act in each iteration, others only now and then."""
