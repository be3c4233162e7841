"""Train many captures: a list of captures becomes command lines, which Ray runs on the CPUs and GPUs of one machine or a cluster."""
