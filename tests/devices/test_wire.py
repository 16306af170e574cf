"""The wire: packets survive any cutting, damage is noticed, and messages read back."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit.devices.wire import messages
from btfkit.devices.wire.messages import Exposed, Hello, Refusal, State, Status
from btfkit.devices.wire.packets import MOST_PAYLOAD, OVERHEAD, Kind, Packet, Parser

packets = st.builds(
    Packet, st.sampled_from(list(Kind)), st.integers(0, 255), st.integers(0, 65535),
    st.binary(max_size=200),
)  # fmt: skip


def test_a_packet_is_the_bytes_that_the_document_says():
    # By hand: magic, kind 1, code 5, sequence 0x0102, zero, length 2, payload, CRC-32.
    body = bytes.fromhex("b7f1 01 05 0201 0000 02000000 aabb")
    assert Packet(Kind.REQUEST, 5, 0x0102, b"\xaa\xbb").encoded() == body + struct.pack(
        "<I", zlib.crc32(body)
    )
    assert len(body) + 4 == OVERHEAD + 2


@given(sent=st.lists(packets, max_size=6), cuts=st.lists(st.integers(1, 50), min_size=1))
def test_packets_come_out_of_a_stream_however_it_is_cut(sent, cuts):
    stream = b"".join(packet.encoded() for packet in sent)
    parser, found, at, turn = Parser(), [], 0, 0
    while at < len(stream):
        step = cuts[turn % len(cuts)]
        found += parser.feed(stream[at : at + step])
        at, turn = at + step, turn + 1
    assert found == sent
    assert parser.damaged == parser.skipped == 0


@given(lost=packets, kept=packets, place=st.integers(0, 10_000), bit=st.integers(0, 7))
def test_a_flipped_bit_costs_its_packet_alone(lost, kept, place, bit):
    # Enough behind it that a length which was damaged to be longer finds its end.
    behind = kept.encoded() * 3
    damaged = bytearray(lost.encoded())
    damaged[place % len(damaged)] ^= 1 << bit
    found = Parser().feed(bytes(damaged) + behind)
    assert lost not in found or lost == kept
    assert len(found) <= 3
    assert all(packet == kept for packet in found)


@given(noise=st.binary(max_size=60).filter(lambda b: b"\xb7" not in b), packet=packets)
def test_noise_before_a_packet_is_skipped_and_counted(noise, packet):
    parser = Parser()
    assert parser.feed(noise + packet.encoded()) == [packet]
    assert parser.skipped == len(noise)


def test_the_rest_that_does_not_come_is_forgotten():
    parser, packet = Parser(), Packet(Kind.ACK, 3, 9, b"abcdef")
    assert parser.feed(packet.encoded()[:-3]) == []
    parser.reset()
    assert parser.feed(packet.encoded()) == [packet]


def test_no_payload_is_longer_than_the_protocol_has_it():
    with pytest.raises(ValueError, match="65537 bytes; at most 65536"):
        Packet(Kind.DATA, 11, 1, bytes(MOST_PAYLOAD + 1)).encoded()


def test_messages_read_back():
    hello = Hello(1, 4, 77, 1234)
    assert Hello.parsed(hello.packed()) == hello
    status = Status(State.HOMED | State.MOVING, 1, 2.5, 0.98, 31.0, (0.1, -2.0), (0.1, -2.1))
    assert Status.parsed(status.packed()) == status
    exposed = Exposed(
        7, 8, 640, 480, 1, 614408, 99, 0.02, 100.0, 3.5, 0.97, 30.0, (0.1, 0.2), (0.1, 0.3)
    )
    assert Exposed.parsed(exposed.packed()) == exposed
    assert messages.parse_move(messages.move({0: 0.5, 3: -1.25})) == {0: 0.5, 3: -1.25}
    assert messages.parse_expose(messages.expose(0.02, 100.0)) == (0.02, 100.0)
    assert messages.parse_read(messages.read(3, 65536, 512)) == (3, 65536, 512)
    assert messages.parse_lamp(messages.lamp(2)) == 2
    assert messages.parse_nak(messages.nak(Refusal.BUSY, "später")) == (Refusal.BUSY, "später")
    assert messages.parse_nak(b"\xfe?") == (Refusal.UNKNOWN, "?")


@pytest.mark.parametrize(
    "parse", [Hello.parsed, Status.parsed, Exposed.parsed, messages.parse_move]
)
def test_a_payload_of_another_size_does_not_parse(parse):
    with pytest.raises(struct.error):
        parse(bytes(77))
