"""What a run leaves behind: splats, light, and a textured mesh, in formats that other programs read."""
