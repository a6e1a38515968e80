"""Laws for what others add: a hand, a kernel, a simulator. Each is checked by one call, which names what is broken."""

from torchgrasp.errors import BrokenLaw
from torchgrasp.testing.hands import check_hand
from torchgrasp.testing.kernels import check_kernel
from torchgrasp.testing.scenes import check_scene

__all__ = ["BrokenLaw", "check_hand", "check_kernel", "check_scene"]
