"""The world of the twin: motors, lamp, camera and sample in one clock, without any electronics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.devices.clock import Clock
from btfkit.devices.twin import layout
from btfkit.devices.twin.geometry import Truth
from btfkit.devices.twin.imperfections import Imperfections
from btfkit.devices.twin.lamp import LAMP, PANEL, Lamp
from btfkit.devices.twin.motion import Motor
from btfkit.devices.twin.scene import GRID, Scene
from btfkit.devices.twin.sensor import Sensor
from btfkit.relief.relief import Relief

_COLD_C, _WARM_K, _WARM_S = 24.0, 8.0, 1500.0
# The panel's radiance, in that of a white surface under the lamp.
_PANEL = 0.5


@final
class TwinClock(Clock):
    """Time that passes when somebody waits for it."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now = start_s

    def now(self) -> float:
        return self._now

    def wait(self, seconds: float) -> None:
        self._now += max(seconds, 0.0)

    def until(self, time_s: float) -> None:
        """Go on to a time, unless it is over."""
        self._now = max(self._now, time_s)


@final
@dataclass(frozen=True)
class Setup:
    """What kind of twin it is.

    Attributes:
        relief: of the sample; None switches the camera's model off: frames are empty.
        width, height: of the sensor, pixels.
        imperfections: what is on. seed: of all that is drawn.
        grid: rays a side of a pixel.
        session: how often this twin was switched on before. start_s: of its clock.
    """

    relief: Relief | None
    width: int = 640
    height: int = 480
    imperfections: Imperfections = field(default_factory=Imperfections)
    seed: int = 0
    grid: int = GRID
    session: int = 0
    start_s: float = 0.0


@final
class World:
    """Everything that has a state.

    Attributes:
        nominal: the description that the firmware holds. truth: how the rig really is.
        motors: in the order of the description's axes. lamp: and panel.
    """

    def __init__(self, setup: Setup) -> None:
        faults = setup.imperfections
        bits = 12 if "quantisation" in faults else 16
        self.setup = setup
        self.clock = TwinClock(setup.start_s)
        self.nominal: dict[str, Any] = layout.describe(
            setup.width, setup.height, bits=bits, mosaic="mosaic" in faults
        )
        # What a rig is does not change from one time to the next that it is switched on.
        built = [np.random.default_rng([setup.seed, part]) for part in range(3)]
        self._random = np.random.default_rng([setup.seed, 3, setup.session])
        self.truth = Truth.of(self.nominal, faults, built[0])
        self.motors = [Motor(axis, faults, self._random) for axis in layout.axes()]
        self.lamp = Lamp(faults, built[1])
        self._sensor: Sensor | None = None
        self._scene: Scene | None = None
        if setup.relief is not None:
            self._sensor = Sensor(self.nominal["sensor"], faults, built[2])
            self._scene = Scene(setup.relief, self.nominal, self.truth, faults, grid=setup.grid)
        self._seen: tuple[tuple[float, ...], NDArray[np.float32]] | None = None

    def temperature_c(self, time_s: float) -> float:
        """Of the sensor, which warms up with the room's electronics."""
        since = time_s - self.setup.start_s
        return _COLD_C + _WARM_K * (1 - float(np.exp(-since / _WARM_S)))

    def angles(self, time_s: float) -> dict[str, float]:
        """Where the axes really are."""
        return {motor.axis.name: motor.shaft(time_s) for motor in self.motors}

    def counts(self, exposure_s: float, iso: float, began_s: float) -> NDArray[np.uint16]:
        """(h, w) or (h, w, 3) of an exposure; empty where there is no model of the camera."""
        if self._sensor is None or self._scene is None:
            return np.zeros((0, 0), np.uint16)
        middle = began_s + exposure_s / 2
        light = self._light(self._sensor, self._scene, middle)
        return self._sensor.exposed(
            light * np.float32(self.lamp.power(middle)),
            exposure_s,
            iso=iso,
            temperature_c=self.temperature_c(middle),
            rng=self._random,
        )

    def record(self, time_s: float) -> Mapping[str, Any]:
        """What really was at a time, for whoever compares with the truth."""
        return {"angles": self.angles(time_s), "power": self.lamp.power(time_s)}

    def _light(self, sensor: Sensor, scene: Scene, time_s: float) -> NDArray[np.float32]:
        if self.lamp.source == PANEL:
            even = np.float32(_PANEL) * scene.lens.flat()
            return sensor.filtered(np.repeat(even[..., None], 3, axis=-1))
        if self.lamp.source != LAMP:
            return sensor.filtered(np.zeros((*sensor.size, 3), np.float32))
        angles = self.angles(time_s)
        key = tuple(angles.values())
        # The exposures of one pose differ in time alone.
        if self._seen is None or self._seen[0] != key:
            self._seen = (key, sensor.filtered(scene.image(self.truth.placed(angles))))
        return self._seen[1]
