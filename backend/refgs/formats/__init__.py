"""Read and write files: PLY, EXR, glTF, OBJ, COLMAP's models, history.jsonl. Nothing here imports torch."""
