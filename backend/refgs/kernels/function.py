"""Define the base class of our autograd functions."""

from typing import Any

import torch


class Function(torch.autograd.Function):
    """Differentiate by kernels. `backward` takes a gradient for each result of `forward`, by position."""

    backward: Any  # torch declares it with any number of gradients, which no function with a fixed number matches
