"""Read and write files and the plain arrays they hold: PLY, EXR, glTF, OBJ, COLMAP's models, history.jsonl. No torch."""
