"""Define the base class of our autograd functions."""

from typing import Any

import torch


class Function(torch.autograd.Function):
    """Run kernels as an autograd function; `backward` takes one gradient for each result."""

    backward: Any  # torch declares it with any number of gradients, which no function with a fixed number matches
