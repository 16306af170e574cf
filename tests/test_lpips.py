"""LPIPS against the same network computed by torch; files that hold something else are refused."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file

from btfkit.btf import BTF
from btfkit.cli import btfkit
from btfkit.cli.outcome import run as run_cli
from btfkit.errors import FormatError
from btfkit.fitting.fit import fit
from btfkit.io.store import writer
from btfkit.lpips import LPIPS

# torchvision's features: convolutions (in, out, side, stride, pad), M for a pool; T for a tap.
ALEX = [(3, 64, 11, 4, 2), "T", "M3", (64, 192, 5, 1, 2), "T", "M3", (192, 384, 3, 1, 1), "T",
        (384, 256, 3, 1, 1), "T", (256, 256, 3, 1, 1), "T"]  # fmt: skip
VGG = []
for group in (
    (3, 64, 64),
    (64, 128, 128),
    (128, 256, 256, 256),
    (256, 512, 512, 512),
    (512, 512, 512, 512),
):
    VGG += [
        *(["M2"] if group[0] > 3 else []),
        *((a, b, 3, 1, 1) for a, b in itertools.pairwise(group)),
        "T",
    ]
NUMBERS = {"alex": [0, 3, 6, 8, 10], "vgg": [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]}
PLANS = {"alex": ALEX, "vgg": VGG}


def weights(network: str) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    state, numbers, taps, slices = {}, iter(NUMBERS[network]), 0, 1
    out = 0
    for part in PLANS[network]:
        if isinstance(part, tuple):
            into, out, side = part[:3]
            name = f"net.slice{slices}.{next(numbers)}"
            scale = (2 / (into * side * side)) ** 0.5
            state[f"{name}.weight"] = scale * torch.randn(out, into, side, side, generator=g)
            state[f"{name}.bias"] = 0.1 * torch.randn(out, generator=g)
        elif part == "T":
            # Published ones have either sign, too.
            lin = torch.rand(1, out, 1, 1, generator=g) - 0.2
            state[f"lin{taps}.model.1.weight"] = lin
            state[f"lins.{taps}.model.1.weight"] = lin.clone()
            taps, slices = taps + 1, slices + 1
    state["scaling_layer.shift"] = torch.tensor([-0.030, -0.088, -0.188])[None, :, None, None]
    return state


def by_torch(
    network: str, state: dict[str, torch.Tensor], one: np.ndarray, other: np.ndarray
) -> float:
    shift, scale = (
        torch.tensor(v).view(1, 3, 1, 1) for v in ([-0.030, -0.088, -0.188], [0.458, 0.448, 0.450])
    )
    x = torch.from_numpy(np.stack([one, other])).permute(0, 3, 1, 2).float()
    x = (x * 2 - 1 - shift) / scale
    convolutions = iter([(v, state[k.replace("weight", "bias")]) for k, v in state.items()
                         if k.startswith("net") and k.endswith("weight")])  # fmt: skip
    total, tap = 0.0, 0
    for part in PLANS[network]:
        if isinstance(part, tuple):
            x = F.relu(F.conv2d(x, *next(convolutions), stride=part[3], padding=part[4]))
        elif part == "T":
            unit = x / (x.norm(dim=1, keepdim=True) + 1e-10)
            square = (unit[:1] - unit[1:]) ** 2
            total += float(F.conv2d(square, state[f"lin{tap}.model.1.weight"]).mean())
            tap += 1
        else:
            x = F.max_pool2d(x, int(part[1]), 2)
    return total


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("lpips")
    for network in PLANS:
        save_file(weights(network), folder / f"{network}.safetensors")
    return {network: folder / f"{network}.safetensors" for network in PLANS}


@pytest.mark.parametrize(
    ("network", "shape"),
    [
        ("alex", (64, 47)),
        ("alex", (33, 40)),
        pytest.param("vgg", (19, 33), marks=pytest.mark.slow),
    ],
)
def test_it_is_what_torch_computes(network, shape, files):
    rng = np.random.default_rng(1)
    one = rng.random((*shape, 3)).astype(np.float32)
    other = np.clip(one + 0.1 * rng.standard_normal(one.shape), 0, 1).astype(np.float32)
    metric = LPIPS(files[network])
    assert metric.network == network
    wanted = by_torch(network, weights(network), one, other)
    # Sums of up to 4608 float32 products, in another order, through 13 layers.
    assert metric(one, other) == pytest.approx(wanted, rel=1e-3, abs=1e-5)
    assert abs(wanted) > 1e-3
    assert metric(one, one) == 0
    assert metric(other, one) == pytest.approx(metric(one, other), rel=1e-6)


def test_names_of_torchvision_serve_as_well(files, tmp_path):
    renamed = {}
    for name, value in weights("alex").items():
        if name.startswith("net."):
            renamed["features." + name.split(".", 2)[2]] = value
        elif name.startswith("lin") and not name.startswith("lins"):
            renamed[name] = value
    save_file(renamed, tmp_path / "a.safetensors")
    one, other = np.zeros((40, 40, 3)), np.ones((40, 40, 3)) * 0.5
    assert LPIPS(tmp_path / "a.safetensors")(one, other) == LPIPS(files["alex"])(one, other)


def test_other_files_and_pictures_are_refused(files, tmp_path):
    (tmp_path / "a.safetensors").write_bytes(b"PK\3\4" * 20)
    with pytest.raises(FormatError, match="not a readable safetensors file"):
        LPIPS(tmp_path / "a.safetensors")
    save_file({"x": torch.ones(3)}, tmp_path / "b.safetensors")
    with pytest.raises(
        FormatError, match="no first layer; expected the weights of LPIPS with alex or vgg"
    ):
        LPIPS(tmp_path / "b.safetensors")
    state = weights("alex")
    squeezed = {**state, "net.slice1.0.weight": torch.ones(64, 3, 3, 2)}
    save_file(squeezed, tmp_path / "c.safetensors")
    with pytest.raises(FormatError, match=r"a first layer of shape \(64, 3, 3, 2\)"):
        LPIPS(tmp_path / "c.safetensors")
    del state["lin3.model.1.weight"], state["lins.3.model.1.weight"]
    save_file(state, tmp_path / "d.safetensors")
    with pytest.raises(FormatError, match="lin3 of alex is missing"):
        LPIPS(tmp_path / "d.safetensors")
    state = weights("alex")
    state["net.slice2.3.bias"][0] = float("nan")
    save_file(state, tmp_path / "e.safetensors")
    with pytest.raises(FormatError, match=r"features.3.bias holds values that are not finite"):
        LPIPS(tmp_path / "e.safetensors")
    with pytest.raises(ValueError, match="LPIPS of 12 x 12 pictures: too small for alex"):
        LPIPS(files["alex"])(np.zeros((12, 12, 3)), np.zeros((12, 12, 3)))
    with pytest.raises(ValueError, match="expected"):
        LPIPS(files["alex"])(np.zeros((40, 40, 1)), np.zeros((40, 40, 1)))
    with pytest.raises(FileNotFoundError):
        LPIPS(tmp_path / "none")


def test_eval_tells_lpips_and_gains_only_where_they_are_asked_for(files, tmp_path, capsys):
    rng = np.random.default_rng(0)
    light = np.array([[0, 0, 1], [0.5, 0, 0.8], [0, 0.5, 0.8], [-0.5, 0, 0.8]], np.float32)
    images = rng.uniform(0.1, 0.8, (4, 40, 40, 3)).astype(np.float32)
    btf = BTF(images, light, np.tile(light[:1], (4, 1)))
    writer.write(btf, tmp_path / "a.btf.zarr", dtype="float32")
    fit(btf, model="lambert", out=tmp_path / "a.safetensors")
    asked = [
        "eval",
        str(tmp_path / "a.safetensors"),
        str(tmp_path / "a.btf.zarr"),
        "--all",
        "--json",
    ]

    def told(*more: str) -> dict:
        assert run_cli(btfkit, [*asked, *more]) == 0
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    plain = told()
    assert not {"lpips", "lpips_weights", "psnr_gains"} & plain.keys()
    found = told("--lpips", str(files["alex"]), "--gains")
    assert found["lpips"] > 0
    assert found["lpips_weights"]["network"] == "alex"
    assert {"psnr_gains", "lpips_gains"} <= found.keys()
    assert found["psnr"] == plain["psnr"]
    assert run_cli(btfkit, [*asked, "--lpips", str(tmp_path / "none")]) == 1
