"""What every engine is: the parameters of a NeuMIP, and how they take a step."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar, final

from btfkit.fitting.neumip.data import Batch
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.native.neural.layout import Array

if TYPE_CHECKING:
    from torch import Tensor

# Names of what is trained, and of the moments that Adam keeps of each.
PARAMETERS = ("weights", "texels")
MOMENTS = ("first", "second")
B = TypeVar("B", bound=Sized)


@final
@dataclass(frozen=True)
class Step:
    """What is done with the gradient of a batch.

    Attributes:
        number: of the step, from 1.
        rates: of Adam, for the weights and for the texels. betas: of its moments.
        dense: whether texels without a gradient move, too.
        kept: factor on the weights afterwards. blur: of the finest textures afterwards, texels.
    """

    number: int
    rates: tuple[float, float]
    betas: tuple[float, float]
    dense: bool
    kept: float
    blur: float


class Engine(ABC, Generic[B]):
    """Parameters and moments, where batches are drawn, and what takes gradients and steps.

    Equal states, batches and steps lead to equal states, on a GPU to rounding only. A state of one
    engine is one of every other.

    Attributes:
        device: torch's name of where the parameters are.
    """

    device: str = "cpu"

    @abstractmethod
    def batch(self, number: int, count: int) -> B:
        """The `count` queries with answers of step `number`, where the engine reads them."""

    def take(self, batch: B, step: Step) -> float:
        """One step; its loss, or NaN where parameters are no numbers any more."""
        loss, *gradients = self.pull(batch)
        return self.push(loss, gradients, step)

    @abstractmethod
    def pull(self, batch: B) -> tuple[Tensor, Tensor, Tensor]:
        """Loss of a batch, its gradients by weights and by texels, where the parameters are."""

    @abstractmethod
    def push(self, loss: Tensor, gradients: Sequence[Tensor], step: Step) -> float:
        """The step that gradients of weights and texels lead to; returns as `take`."""

    @abstractmethod
    def parameters(self) -> tuple[Array, Array]:
        """Weights and texels as they stand, in the CPU's memory."""

    def change(self, edit: Callable[[Array, Array], None]) -> None:
        """Have `edit` change weights and texels in place, wherever they are."""
        edit(*self.parameters())

    @abstractmethod
    def state(self) -> dict[str, Array]:
        """Copies of parameters and moments, in the CPU's memory."""

    @abstractmethod
    def restore(self, state: Mapping[str, Array]) -> None:
        """Take back what `state` gave."""

    def ended(self) -> Engine[Any] | None:
        """What goes on alone, of an engine whose steps several processes took; else None."""
        return None

    def answers(self, material: NeuMIPMaterial, held: Batch) -> Array:
        """Reflectance (b, c) of a material for the held-out queries."""
        blur = 0.5 if held.footprint is None else held.footprint
        bend = 0.0 if held.curvature is None else held.curvature
        return material.evaluate(held.uv, held.light, held.view, blur, bend).reflectance
