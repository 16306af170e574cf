"""Our optimisers against torch's."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import nn

from btfkit.fitting.optimisers import Adam


def test_adam_takes_the_steps_of_torchs_own_and_goes_on_from_its_state():
    generator = torch.Generator().manual_seed(0)
    ours = [nn.Parameter(torch.randn(n, generator=generator)) for n in (5, 3)]
    theirs = [nn.Parameter(p.detach().clone()) for p in ours]
    mine = Adam(ours, lr=0.1, betas=(0.9, 0.99))
    reference = torch.optim.Adam(theirs, lr=0.1, betas=(0.9, 0.99), foreach=False)
    for step in range(12):
        for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
            # One parameter has no gradient at first: it must not move, nor count its steps.
            a.grad = None if k and step < 4 else torch.randn(a.shape, generator=generator)
            b.grad = None if a.grad is None else a.grad.clone()
        mine.step()
        reference.step()
        if step == 6:
            again = Adam(ours, lr=0.0, betas=(0.9, 0.99))
            again.load_state_dict(mine.state_dict())
            mine = again
    for a, b in zip(ours, theirs, strict=True):
        # float32, a dozen roundings.
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
    mine.zero_grad()
    assert all(p.grad is None for p in ours)
    with pytest.raises(ValueError, match="forgotten"):
        mine.zero_grad(set_to_none=False)


@pytest.mark.slow
def test_a_step_loads_no_compiler():
    code = (
        "import sys, torch\n"
        "from btfkit.fitting.neubtf.muon import Muon\n"
        "from btfkit.fitting.optimisers import Adam\n"
        "p = torch.nn.Parameter(torch.ones(2, 2)); p.grad = torch.ones(2, 2)\n"
        "Adam([p], lr=0.1, betas=(0.9, 0.99)).step(); Muon([p], lr=0.1).step()\n"
        "print('torch._dynamo' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False"]
