"""The rows that a fit reads: all of them in one process, or a share in each process that torchrun started."""

import dataclasses

import torch.distributed
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument


@dataclasses.dataclass(frozen=True)
class Shard:
    """The rows of one process. Several processes form the default group of torch.distributed."""

    rows: Float[Tensor, "n d"]
    rank: int = 0
    processes: int = 1

    @staticmethod
    def of(rows: Float[Tensor, "n d"], distributed: bool) -> "Shard":
        """Return the shard of this process; raises `BadArgument` for a distributed one without a group."""
        if not distributed:
            return Shard(rows)
        if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
            allowed = "True after torch.distributed.init_process_group, as under torchrun"
            raise BadArgument("distributed", "True in a process without a group", allowed)
        return Shard(rows, torch.distributed.get_rank(), torch.distributed.get_world_size())

    def sum(self, x: Tensor) -> Tensor:
        """Return the sum of x over all processes; every process gets the same bits."""
        if self.processes > 1:
            x = x.clone()
            torch.distributed.all_reduce(x)
        return x

    def count(self) -> int:
        """Count the rows of all processes."""
        return int(self.sum(self.rows.new_tensor(len(self.rows), dtype=torch.int64)))
