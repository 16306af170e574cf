"""From the poses of a manifest and its images to a BTF."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from btfkit import colour
from btfkit.btf import BTF, COLOUR, RGB
from btfkit.errors import FormatError
from btfkit.io import images, named, spectral, spelling
from btfkit.io.archive import Archive
from btfkit.io.images import Image, exr
from btfkit.io.manifest.poses import MM, End, Pose
from btfkit.nearfield import PointLight
from btfkit.textures import Array

_ABOVE = End((0.0, 0.0, 1.0), None)
_LARGEST = 10**15


@final
@dataclass(frozen=True)
class Head:
    """What a manifest and the caller say about all images.

    Attributes:
        transfer, cosine, texel_mm, wrap, colour, licence: as in `BTF` and the readers' options.
        channels: to pick by name from EXRs; None takes what the first image has.
        light_power: (1 or c,) power of a point light, radiance x mm^2; None where values count
            as the quantity already.
        history, origin: of the BTF that was written.
        record: entries of the provenance.
    """

    transfer: str
    cosine: str
    texel_mm: float | None
    wrap: Any
    colour: str
    licence: str | None
    channels: tuple[str, ...] | None
    light_power: tuple[float, ...] | None
    history: tuple[str, ...]
    origin: Mapping[str, Any]
    record: Mapping[str, Any]

    @classmethod
    def of(cls, path: Path, head: Mapping[str, Any], given: Mapping[str, Any]) -> Head:
        """Checked; options given come before what the manifest says.

        Raises:
            FormatError: an entry of the wrong kind.
        """

        def entry(name: str, kind: type | tuple[type, ...], default: Any) -> Any:
            value = head.get(name)
            if value is None:
                return default
            if not isinstance(value, kind) or isinstance(value, bool):
                raise FormatError(path, f"{name} is {str(value)[:60]!r}")
            if isinstance(value, int) and abs(value) > _LARGEST:
                raise FormatError(path, f"{name} is no sensible number")
            return value

        def names(name: str) -> tuple[str, ...]:
            values = entry(name, list, [])
            if not all(isinstance(value, str) for value in values):
                raise FormatError(path, f"{name} is {str(values)[:60]!r}; expected names")
            return tuple(values)

        stated = {
            "transfer": entry("transfer", str, None),
            "cosine": entry("cosine", str, None),
            "texel_mm": entry("texel_mm", (int, float), None),
        }
        defaults = {"transfer": "srgb", "cosine": "in"}
        settled = {
            key: given[key] if given[key] is not None else value for key, value in stated.items()
        }
        assumed = {key: value for key, value in defaults.items() if settled[key] is None}
        settled.update(assumed)
        try:
            named.cosine_factor(settled["cosine"], np.ones((1, 3)))
            colour.decode(settled["transfer"], np.zeros(1))
        except ValueError as error:
            raise FormatError(path, str(error)) from error
        power = head.get("light_power")
        return cls(
            **settled,
            wrap=entry("wrap", str, "clamp"),
            colour=entry("colour", str, COLOUR),
            licence=entry("licence", str, None),
            channels=names("channels") or None,
            light_power=None if power is None else _power(path, power, head.get("units", "mm")),
            history=names("history"),
            origin=entry("provenance", dict, {}),
            record={
                "options": {key: value for key, value in given.items() if value is not None},
                "assumed": assumed,
            },
        )


def assemble(path: Path, holder: Archive, base: str, head: Head, entries: Sequence[Pose]) -> BTF:
    """The BTF of poses whose images lie in `holder`, relative to its folder `base`.

    Raises:
        FormatError: nothing there, a file outside the folder, or poses that do not fit.
    """
    present, files, missing = _present(path, holder, base, entries)
    light, light_mm = _ends(path, "light", [pose.light for pose in present])
    view, view_mm = _ends(path, "view", [pose.view or _ABOVE for pose in present])
    record = dict(head.record)
    if all(pose.view is None for pose in present):
        record["assumed"] = {**record["assumed"], "view": "from above"}
    codes = named.Decoder(head.transfer, assumed="transfer" in head.record["assumed"])
    decode = _Decode(codes, head.channels)
    plain = named.ImageTextures(holder, files, decode)
    exposure = _exposures(path, present)
    near = _near_light(path, head, light_mm, plain.shape[3])
    far = named.cosine_factor(head.cosine, light) if light_mm is None else None

    gains = named.Gains(exposure[:, None])
    variance = _variance(path, holder, base, present, head)
    unscaled = near is None and far is None and (exposure == 1).all()
    footprint = _numbers(path, present, "footprint")
    return named.assembled(
        path,
        plain if unscaled else plain.scaled(named.Product(gains, near, far)),
        light=light,
        view=view,
        light_position=light_mm,
        view_position=view_mm,
        variance=(
            variance
            if unscaled or variance is None
            else variance.scaled(named.Product(gains, near, far, power=2))
        ),
        footprint=None if footprint is None else footprint.astype(np.float32),
        channels=decode.channels,
        colour=head.colour,
        texel_mm=head.texel_mm,
        wrap=head.wrap,
        licence=head.licence,
        history=head.history,
        provenance={
            "source": str(path),
            "format": "manifest",
            "missing_images": missing,
            **({"origin": dict(head.origin)} if head.origin else {}),
            **record,
        },
    )


@final
class _Decode:
    """Images with the channels that the manifest names, or else by what the first one holds.

    Without names an EXR is its colour, or its wavelengths where it has such.

    Args:
        codes: of everything but EXRs.
        channels: to pick by name; None takes what the first image has.
        variance: whether values are variances: of a mixture its squared weights count.

    Attributes:
        channels: those that were taken, once an image is decoded; layers' prefixes fall off.
    """

    def __init__(
        self, codes: named.Decoder, channels: tuple[str, ...] | None, *, variance: bool = False
    ) -> None:
        self._codes, self._asked, self._variance = codes, channels, variance
        self.channels: tuple[str, ...] | None = None

    def __call__(self, name: str, data: bytes) -> Image:
        if not name.lower().endswith(".exr"):
            return self._codes(name, data)
        file = images.read_exr(name, data)
        names = file[1]
        waves = {} if self._asked else spectral.wavelengths(name, names)
        taken = self._asked or tuple(waves[nm] for nm in sorted(waves)) or exr.colours(name, names)
        lacking = [n for n in taken if n not in names]
        if lacking:
            raise FormatError(
                name, f"has channels {', '.join(names[:8])}; expected {', '.join(lacking[:8])}"
            )
        image = exr.of_channels(name, file, taken, variance=self._variance)
        if waves:
            taken = tuple(f"{nm:g}" for nm in sorted(waves))
        self.channels = RGB if exr.is_rgb(taken) else taken
        return image


def _present(
    path: Path, holder: Archive, base: str, entries: Sequence[Pose]
) -> tuple[list[Pose], list[str], int]:
    """The poses whose images are there, the members that these are, and how many are not there."""
    if not entries:
        raise FormatError(path, "names no image")
    found = [_member(path, holder, base, pose.file) for pose in entries]
    there = [(pose, file) for pose, file in zip(entries, found, strict=True) if file is not None]
    again = [file for file, count in Counter(file for _, file in there).items() if count > 1]
    if again:
        raise FormatError(path, f"{again[0]!r} is named twice", remedy="remove one")
    missing = len(entries) - len(there)
    if not there:
        raise FormatError(path, f"none of the {len(entries)} images it names is there")
    if missing:
        lost = next(pose.file for pose, file in zip(entries, found, strict=True) if file is None)
        warnings.warn(
            f"{path}: {missing} of {len(entries)} images are missing, first {lost!r}", stacklevel=4
        )
    return [pose for pose, _ in there], [file for _, file in there], missing


def _member(path: Path, holder: Archive, base: str, name: str) -> str | None:
    """The member that an entry means; a path of another machine by its last parts."""
    elsewhere = spelling.is_absolute(name) and images.is_image(name.replace("\\", "/"))
    if spelling.inside(name, base) is None and not elsewhere:
        raise FormatError(
            path,
            f"{name!r} would leave the folder of the manifest",
            remedy="put the manifest above its images",
        )
    return holder.locate_image(name, base)


def _ends(path: Path, name: str, ends: Sequence[End]) -> tuple[Array, Array | None]:
    """(n, 3) directions, and positions in mm where all have them."""
    placed = [end.position_mm is not None for end in ends]
    if any(placed) != all(placed):
        at = placed.index(False)
        raise FormatError(path, f"image {at} (from 0) has no {name} position; others have")
    to = np.array([end.direction or end.position_mm for end in ends])
    # What is given as a position is a direction from the centre of the sample.
    at_mm = np.array([end.position_mm for end in ends], np.float32) if all(placed) else None
    return to, at_mm


def _numbers(path: Path, present: Sequence[Pose], key: str) -> Array | None:
    known = [pose.numbers[key] for pose in present if key in pose.numbers]
    if not known:
        return None
    if len(known) < len(present) or min(known) <= 0:
        raise FormatError(path, f"{key} must be above 0 and there for all images or for none")
    return np.array(known)


def _exposures(path: Path, present: Sequence[Pose]) -> Array:
    """(n,) factors that bring all images to the exposure of the first."""
    total = np.ones(len(present))
    for key, power in (("exposure_s", 1), ("iso", 1), ("f", -2)):
        values = _numbers(path, present, key)
        total = total if values is None else total * values**power
    return (total[0] / total).astype(np.float32)


def _near_light(path: Path, head: Head, light_mm: Array | None, channels: int) -> PointLight | None:
    if light_mm is None:
        if head.light_power is not None:
            raise FormatError(path, "light_power needs positions of the lights")
        return None
    if head.light_power is None and head.cosine == "in":
        return None
    if head.texel_mm is None:
        raise FormatError(
            path, "lights with positions need texel_mm", remedy="give it with --texel-mm"
        )
    power = None
    if head.light_power is not None:
        if len(head.light_power) not in (1, channels):
            raise FormatError(path, f"{len(head.light_power)} powers for {channels} channels")
        power = np.broadcast_to(head.light_power, (len(light_mm), len(head.light_power)))
    return PointLight(light_mm, head.texel_mm, power, head.cosine == "out")


def _power(path: Path, power: Any, units: Any) -> tuple[float, ...]:
    values = power if isinstance(power, list) else [power]
    numbers = [
        isinstance(v, (int, float)) and not isinstance(v, bool) and 1 / _LARGEST < v < _LARGEST
        for v in values
    ]
    if not values or not all(numbers):
        raise FormatError(path, f"light_power is {str(power)[:60]}; expected numbers above 0")
    return tuple(float(value) * MM[units] ** 2 for value in values)


def _variance(
    path: Path, holder: Archive, base: str, present: Sequence[Pose], head: Head
) -> named.ImageTextures | None:
    files = [pose.variance for pose in present if pose.variance is not None]
    if not files:
        return None
    members = [_member(path, holder, base, file) for file in files]
    if len(files) < len(present) or None in members:
        raise FormatError(path, "variance must be there for all images or for none")
    decode = _Decode(named.Decoder("linear", assumed=False), head.channels, variance=True)
    return named.ImageTextures(holder, [m for m in members if m], decode)
