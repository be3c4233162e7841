"""Train many captures: a list of them becomes command lines, which Ray runs on the cores and cards of one machine or a cluster."""
