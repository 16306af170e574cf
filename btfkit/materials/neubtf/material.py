"""NeuBTF with heights: textures that an encoder gave, answered as NeuMIP answers.

Sources: Rodriguez-Pardo et al., "NeuBTF: Neural fields for BTF encoding and transfer", Computers &
Graphics 114, 2023, whose future work names a parallax module; Kuznetsov et al., "NeuMIP:
Multi-Resolution Neural Materials", ACM TOG 40(4), 2021.
"""

from __future__ import annotations

from typing import ClassVar, final

from btfkit.materials.neubtf.paper import NeuBTFPaper
from btfkit.materials.neumip.material import AnyNeuMIP


@final
class NeuBTF(AnyNeuMIP):
    """Heights and features of one guidance, and the decoder that they were fitted with."""

    model: ClassVar[str] = "neubtf"
    has_levels: ClassVar[bool] = False


AnyNeuBTF = NeuBTF | NeuBTFPaper
