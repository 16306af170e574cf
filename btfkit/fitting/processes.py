"""Processes that fit one model together, as `torchrun` starts them.

The first one owns time, state and files; the others follow it.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, final

import torch
import torch.distributed as dist
from torch import Tensor

from btfkit.errors import FitError


@final
class Processes:
    """This process among those that fit one model.

    Attributes:
        rank: 0 for the one that is followed. size: how many there are.
        place: where tensors lie that are exchanged: the CPU for gloo, a GPU for NCCL.
    """

    def __init__(self, device: str) -> None:
        self.place = torch.device("cpu")
        if device == "cuda":
            self.place = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
            torch.cuda.set_device(self.place)
        try:
            dist.init_process_group("nccl" if device == "cuda" else "gloo")
        except (RuntimeError, ValueError) as error:
            raise FitError(
                f"the processes of torchrun do not find each other: {error}",
                remedy="look at MASTER_ADDR and MASTER_PORT",
            ) from error
        self.rank, self.size = dist.get_rank(), dist.get_world_size()

    def mean(self, tensors: list[Tensor]) -> list[Tensor]:
        """Means over all processes, in place."""
        for tensor in tensors:
            dist.all_reduce(tensor)
            tensor /= self.size
        return tensors

    def tell(self, tensor: Tensor) -> Tensor:
        """The first process' tensor, in place."""
        dist.broadcast(tensor, 0)
        return tensor

    def close(self) -> None:
        """Leave the others."""
        dist.destroy_process_group()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C waits for the end: what was sent to other processes is sent whole."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[Any] = []
    before = signal.signal(signal.SIGINT, lambda *_: came.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        raise KeyboardInterrupt
