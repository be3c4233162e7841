"""Represent what a training learns: the surfels and the environment's light."""
