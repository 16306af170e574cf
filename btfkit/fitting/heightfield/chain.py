"""Heights for a model of a measured BTF: its relief, found before the model is fitted."""

from __future__ import annotations

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.heightfield import Progress, bare, find_heights
from btfkit.relief.relief import Relief

# What the relief may take of a budget, the model that parallax begins with of that, and at most.
_SHARE, _MODEL_SHARE, _MOST_MODEL_S = 0.4, 0.3, 20.0
_MOST_STEPS = 2000


def relief_behind(
    btf: BTF,
    *,
    budget_s: float | None,
    steps: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Relief | None, str]:
    """The relief of a BTF, without maps, and in a sentence how it was found or why it was not.

    Its plane is the BTF's own: nothing is moved under it.

    Args:
        btf: the pairs that may be known. budget_s: wall time of the whole fit; None for no limit.
        steps: of that fit, in place of a budget: equal steps find equal heights.
        seed: of all randomness.
    """
    limit = None if budget_s is None else _SHARE * budget_s
    model = _MOST_MODEL_S if limit is None else min(_MODEL_SHARE * limit, _MOST_MODEL_S)
    try:
        stack, solved = find_heights(
            btf, budget_s=model, limit_s=limit, seed=seed, progress=progress,
            steps=None if steps is None else min(steps, _MOST_STEPS),
        )  # fmt: skip
    except (FitError, ValueError) as error:
        return None, f"{_FOUND}: no relief was found before ({error})"
    if solved.why is not None:
        return None, f"{_FOUND}: no relief was found before ({solved.why})"
    height, figures = solved.heights[solved.best], solved.figures
    cut = f", {figures['rounds']} of {figures['rounds_planned']} rounds" * bool(figures["cut"])
    relief = bare(height, wrap=btf.wrap)
    return relief, (
        f"heights: the relief of these pictures by light, parallax and shadows, {len(stack.pairs)} "
        f"pairs{cut}; views disagree by {figures['disagreement']:.3f} of the mean square, "
        f"{figures['disagreement_flat']:.3f} without it"
    )


_FOUND = "heights: found by the model's own march"
