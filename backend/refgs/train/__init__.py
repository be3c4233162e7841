"""Train surfels, materials and light on a capture (photos with cameras), and write them into a run folder."""
