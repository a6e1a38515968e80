"""Sums over the data when several processes hold a share of them each (started by torchrun)."""

from collections.abc import Callable

import torch.distributed
from torch import Tensor

from torchgrasp.errors import BadArgument

AllReduce = Callable[[Tensor], Tensor]
"""What turns a sum over this process's rows into the sum over all rows; every process gets the same bits."""


def local_sum(x: Tensor) -> Tensor:
    """Return the sum itself: this process holds all the data."""
    return x


def sum_over_processes(x: Tensor) -> Tensor:
    """Return the sum over the processes of torch.distributed's default group."""
    x = x.clone()
    torch.distributed.all_reduce(x)
    return x


def choose_allreduce(distributed: bool) -> AllReduce:
    """Return how to sum: over all processes, or over this one alone.

    Raises:
        BadArgument: processes that were not introduced to each other.
    """
    if distributed and not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        allowed = "True after torch.distributed.init_process_group, as under torchrun"
        raise BadArgument("distributed", "True in a process without a group", allowed)
    return sum_over_processes if distributed else local_sum


def device_of(allreduce: AllReduce) -> tuple[int, int]:
    """Return the number of this process and how many there are."""
    if allreduce is local_sum:
        return 0, 1
    return torch.distributed.get_rank(), torch.distributed.get_world_size()
