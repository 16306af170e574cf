"""The reference firmware in C: compiled, and driven by the same driver as everything else."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import zlib
from pathlib import Path

import numpy as np
import pytest

from btfkit.devices import usb as usb_driver
from btfkit.devices.base import PositionError
from btfkit.devices.capture import plan as plans
from btfkit.devices.capture.run import measure
from btfkit.devices.clock import WallClock
from btfkit.devices.virtual import VirtualBus
from btfkit.devices.wire import messages
from btfkit.devices.wire.link import RefusedError
from btfkit.devices.wire.messages import Command, State, Status
from btfkit.devices.wire.packets import Kind, Packet
from btfkit.errors import DeviceError
from btfkit.sequence import Sequence

SOURCE = Path(__file__).parents[2] / "examples" / "firmware" / "rig.c"
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


class Board:
    """A process that speaks the wire over its standard input and output."""

    def __init__(self, program: Path) -> None:
        self.process = subprocess.Popen(
            [program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
        )

    def receive(self, data: bytes) -> None:
        self.process.stdin.write(data)

    def take(self, timeout_s: float) -> bytes:
        out = self.process.stdout
        return os.read(out.fileno(), 1 << 16) if select.select([out], [], [], timeout_s)[0] else b""

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(5)
        self.process.stdout.close()


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    found = tmp_path_factory.mktemp("firmware") / "rig"
    command = [COMPILER, "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-o", found, SOURCE]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return found


@pytest.fixture
def board(program):
    board = Board(program)
    yield board
    board.close()


def a_rig(board):
    bus = VirtualBus(board, ids=(usb_driver.VENDOR, usb_driver.PRODUCT), serial="BOARD")
    return usb_driver.open_rig(backend=bus, clock=WallClock())


def test_the_driver_moves_and_exposes_through_it(board):
    with a_rig(board) as rig:
        with pytest.raises(PositionError, match="home it"):
            rig.stage.position()
        rig.stage.home()
        rig.stage.move_to(turntable=1.25, light_arm=0.5)
        assert rig.stage.position()["turntable"] == 1.25
        rig.light.switch("lamp")
        frame = rig.camera.expose(0.02)
        # 64 counts, and 2000 more along a row of 32.
        expected = (64 + 2000 * np.arange(32) / 32).astype(np.uint16)
        np.testing.assert_array_equal(frame.counts, np.tile(expected, (24, 1)))
        assert (frame.lamp, frame.axes["light_arm"], frame.serial[1]) == (1.0, 0.5, 1)
        assert rig.camera.expose(0.02).serial[1] == 2


def test_it_refuses_whole_what_it_cannot_do(board):
    with a_rig(board) as rig:
        with pytest.raises(RefusedError, match="positions are not known"):
            rig.link.request(Command.MOVE, messages.move({0: 0.1}))
        rig.stage.home()
        for payload in (messages.move({0: 1.0, 3: 9.0}), messages.move({0: float("nan")}), b"abc"):
            with pytest.raises(RefusedError):
                rig.link.request(Command.MOVE, payload)
        with pytest.raises(RefusedError, match="no such axis"):
            rig.link.request(Command.MOVE, messages.move({9: 0.0}))
        assert rig.stage.position()["turntable"] == pytest.approx(-0.08726646)
        for command, payload in (
            (Command.LAMP, messages.lamp(3)), (Command.EXPOSE, messages.expose(99.0, 100.0)),
            (Command.READ, messages.read(7, 0, 8)), (Command.DESCRIBE, b""),
            (Command.READ, messages.read(messages.DESCRIPTION, 1 << 20, 8)),
        ):  # fmt: skip
            with pytest.raises(RefusedError):
                rig.link.request(command, payload)
        rig.emergency_stop()
        with pytest.raises(RefusedError, match="holds until homing"):
            rig.light.switch("lamp")
        assert Status.parsed(rig.link.request(Command.STATUS)).state == State.STOPPED


def test_it_finds_packets_in_noise_and_obeys_a_repeated_number_once(board):
    def said() -> bytes:
        data = b""
        while piece := board.take(0.3):
            data += piece
        return data

    damaged = bytearray(Packet(Kind.REQUEST, Command.HOME, 1).encoded())
    damaged[3] ^= 1
    hello = Packet(Kind.REQUEST, Command.HELLO, 2).encoded()
    board.receive(b"\xb7\xf1\xb7noise" + bytes(damaged) + hello[:7])
    board.receive(hello[7:])
    first = said()
    assert zlib.crc32(first[:-4]) == int.from_bytes(first[-4:], "little")
    assert first[2:6] == bytes([Kind.ACK, Command.HELLO, 2, 0])
    board.receive(Packet(Kind.REQUEST, Command.HOME, 3).encoded())
    homed = said()
    again = Packet(Kind.REQUEST, Command.HOME, 3).encoded()
    board.receive(again)
    # The ack once more, and no second HOMED event.
    assert homed[2] == Kind.ACK
    assert homed[18] == Kind.EVENT
    assert said() == homed[:16]


def test_a_whole_plan_runs_on_it_and_tells_where_it_is_no_rig(board, tmp_path):
    document = {
        "views": [[0, 0], [30, 90]], "lights": [[20, 0]], "exposures": {"times_s": [0.002, 0.004]},
        "darks": {"times_s": [0.001]}, "flats": {"times_s": [0.001]}, "whites": 0, "colours": 0,
        "targets": 1, "spheres": 0, "settle_s": 0, "warm_s": 0,
    }  # fmt: skip
    measure(a_rig(board), plans.from_document("p", document), tmp_path / "run")
    sequence = Sequence.open(tmp_path / "run")
    assert len(sequence.of_kind("sample")) == 4
    assert "synthetic" not in sequence.document
    assert int(sequence.image(sequence.of_kind("sample")[1]).max()) == int(64 + 400 * 31 / 32)
    board.process.kill()
    board.process.wait()
    with pytest.raises((DeviceError, BrokenPipeError)), a_rig(board):
        pass
