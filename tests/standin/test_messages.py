"""Emitters and receivers: who hears whom, when, and what of."""

from __future__ import annotations

from math import isnan, pi
from pathlib import Path

import pytest
from controller import Emitter, Receiver

from webots_mcp.standin import InProcessSimulation, InProcessSupervisor, Simulation

STEP_MS = 16


class Team:
    """Two robots two metres apart on the x axis, facing east."""

    def __init__(self, tmp_path: Path, emitter: str = "", receiver: str = "") -> None:
        self.world = tmp_path / "team.wbt"
        robot = """Robot {{ name "{0}" translation {1} 0 0 supervisor TRUE children [ {2} ] }}"""
        text = (
            "#VRML_SIM R2025a utf8\nWorldInfo { basicTimeStep 16 }\n"
            + robot.format("sender", -1, f"Emitter {{ {emitter} }} Receiver {{ }}")
            + robot.format("listener", 1, f"Receiver {{ {receiver} }}")
        )
        self.world.write_text(text.replace("'", '"'), encoding="utf-8")
        simulation = InProcessSimulation(self.world)
        self.sender = InProcessSupervisor("sender", world=simulation)
        self.listener = InProcessSupervisor("listener", world=simulation)
        self.emitter: Emitter = self.sender.getDevice("emitter")
        self.receiver: Receiver = self.listener.getDevice("receiver")
        self.receiver.enable(STEP_MS)
        self.step()

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            assert self.sender.step(STEP_MS) == self.listener.step(STEP_MS) == 0

    def heard(self, *messages: str) -> list[str]:
        """What arrives of messages that are sent."""
        for message in messages:
            self.emitter.send(message)
        self.step(2)
        arrived: list[str] = []
        while self.receiver.getQueueLength():
            arrived.append(self.receiver.getString())
            self.receiver.nextPacket()
        return arrived


def test_packets_arrive_in_order_with_direction_and_strength(tmp_path: Path) -> None:
    team = Team(tmp_path, receiver=f"rotation 0 0 1 {pi / 2}")
    own: Receiver = team.sender.getDevice("receiver")
    own.enable(STEP_MS)
    team.emitter.send("first")
    team.emitter.send([1.5, -2.0])
    team.emitter.send([3, 4])
    team.emitter.send(b"\x01\x00\x01", 2)
    team.step(2)
    receiver = team.receiver
    assert (receiver.getQueueLength(), own.queue_length) == (4, 0)
    assert receiver.string == "first"
    assert receiver.getSignalStrength() == pytest.approx(1.0 / 4.0)
    assert receiver.getEmitterDirection() == pytest.approx([0.0, 1.0, 0.0])  # it looks north
    receiver.nextPacket()
    assert (receiver.getFloats(), receiver.getDataSize()) == ((1.5, -2.0), 16)
    receiver.nextPacket()
    assert receiver.getInts() == (3, 4)
    receiver.nextPacket()
    assert receiver.getBools() == (True, False)


def test_an_empty_queue_says_so_and_gives_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    receiver = Team(tmp_path).receiver
    assert (receiver.getQueueLength(), receiver.getBytes(), receiver.data_size) == (0, b"", -1)
    assert isnan(receiver.signal_strength)
    receiver.nextPacket()
    functions = ("get_data", "get_data_size", "get_signal_strength")
    assert capfd.readouterr().err.splitlines() == [
        f"Error: wb_receiver_{function}(): the receiver queue is empty." for function in functions
    ]
    for read in (receiver.getString, receiver.getEmitterDirection):
        with pytest.raises(ValueError, match="NULL pointer access"):
            read()


@pytest.mark.parametrize(
    ("emitter", "receiver", "arrives"),
    [
        ("channel 2", "channel 2", True),
        ("channel 2", "channel 3", False),
        ("channel -1", "channel 3", True),
        ("channel 2", "channel -1", True),
        ("range 1.9", "", False),
        ("range 2.1", "", True),
        ("", "type 'infra-red'", False),
        ("type 'infra-red'", "type 'infra-red'", True),
    ],
)
def test_a_packet_arrives_where_it_can_be_heard(
    emitter: str, receiver: str, arrives: bool, tmp_path: Path
) -> None:
    team = Team(tmp_path, emitter, receiver)
    assert team.heard("hello") == (["hello"] if arrives else [])


def test_channel_and_range_can_be_set_while_it_runs(tmp_path: Path) -> None:
    team = Team(tmp_path, "maxRange 1.5 range 1")
    team.emitter.setChannel(7)
    team.receiver.channel = 7
    team.emitter.setRange(5.0)
    assert (team.emitter.range, team.emitter.channel, team.receiver.getChannel()) == (1.5, 7, 7)
    assert team.heard("too far") == []
    place = team.listener.getSelf().getField("translation")
    assert place is not None
    place.setSFVec3f([0.4, 0.0, 0.0])
    team.step()
    assert team.heard("near") == ["near"]


def test_a_slow_receiver_gets_all_with_its_next_sample_and_a_disabled_one_nothing(
    tmp_path: Path,
) -> None:
    team = Team(tmp_path)
    team.receiver.enable(4 * STEP_MS)
    team.step()
    lengths: list[int] = []
    for _ in range(8):
        team.emitter.send("x")
        team.step()
        lengths.append(team.receiver.getQueueLength())
    assert lengths[-1] in (4, 8) and {*lengths} <= {lengths[0], lengths[0] + 4, lengths[0] + 8}
    team.receiver.disable()
    team.heard("y")
    assert team.heard("z") == []


def test_a_message_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    team = Team(tmp_path)
    team.emitter.send(1.0)
    team.emitter.send([])
    team.emitter.send(["one"])
    assert capsys.readouterr().err.splitlines() == [
        "Emitter.send(): unsupported data type: <class 'float'>",
        "Emitter.send(): empty list",
        "Emitter.send(): unsupported data type list: <class 'list'>",
    ]


def test_a_setting_or_message_that_the_c_library_refuses_changes_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    team = Team(tmp_path, "allowedChannels [ 0 4 ] range 3")
    team.emitter.send("")
    team.emitter.setRange(-2.0)
    team.emitter.setChannel(3)
    team.receiver.setChannel(-2)
    assert (team.emitter.range, team.emitter.channel, team.receiver.channel) == (3.0, 0, 0)
    assert team.heard() == []
    inside = "Please use a channel inside the range [-1,inf)."
    allowed = "which is not between allowed channels. Please use an allowed channel."
    assert capfd.readouterr().err.splitlines() == [
        "Error: wb_emitter_send(): invalid size=0 argument.",
        "Error: wb_emitter_set_range(): invalid range=-2.000000 argument.",
        f"Error: wb_emitter_set_channel() called with channel=3, {allowed}",
        f"Error: wb_receiver_set_channel() called with an invalid channel=-2. {inside}",
    ]


def test_a_packet_keeps_the_channel_of_the_moment_when_it_was_sent(tmp_path: Path) -> None:
    team = Team(tmp_path, receiver="channel 1")
    for channel in (1, 2, -1, 3):
        team.emitter.setChannel(channel)
        team.emitter.send(f"on {channel}")
    assert team.heard() == ["on 1", "on -1"]


def test_a_packet_keeps_the_range_of_the_moment_when_it_was_sent(tmp_path: Path) -> None:
    team = Team(tmp_path)  # they are two metres apart
    for range_m in (1.0, 3.0, 0.5, -1.0, 1.5):
        team.emitter.setRange(range_m)
        team.emitter.send(f"to {range_m}")
    assert team.heard() == ["to 3.0", "to -1.0"]


def test_a_packet_without_space_in_a_buffer_is_lost(tmp_path: Path) -> None:
    team = Team(tmp_path, "bufferSize 10", "bufferSize 12")
    assert team.heard("12345", "678901", "67890") == ["12345", "67890"]
    team.emitter.send("12345678")
    team.step(2)
    assert team.heard("12345", "6789") == ["12345678", "6789"]


def test_a_baud_rate_lets_so_many_bytes_through_in_each_step(tmp_path: Path) -> None:
    team = Team(tmp_path, "baudRate 4000")  # 8 bytes in 16 ms
    for text in ("12345678", "1234", "5678", "12345678"):
        team.emitter.send(text)
    lengths: list[int] = []
    while not lengths or lengths[-1] < 4:
        team.step()
        lengths.append(team.receiver.getQueueLength())
    assert [length for length in lengths if length] == [1, 3, 4]


def test_a_reset_drops_what_is_under_way(tmp_path: Path) -> None:
    team = Team(tmp_path)
    team.receiver.enable(8 * STEP_MS)
    team.step()
    team.emitter.send("before")
    team.step(2)
    team.sender.simulationReset()
    team.step(8)
    assert team.heard() == []


def test_controller_processes_talk_to_each_other(tmp_path: Path) -> None:
    sender, listener = tmp_path / "sender.py", tmp_path / "listener.py"
    sender.write_text(
        "from controller import Robot\nrobot = Robot()\nemitter = robot.getDevice('emitter')\n"
        "while robot.step(16) != -1:\n    emitter.send(f'at {robot.getTime():.3f}')\n"
    )
    listener.write_text(
        "from controller import Robot\nrobot = Robot()\nreceiver = robot.getDevice('receiver')\n"
        "receiver.enable(16)\nwhile robot.step(16) != -1:\n"
        "    while receiver.getQueueLength():\n"
        "        print(receiver.getString(), f'at {robot.getTime():.3f}', flush=True)\n"
        "        receiver.nextPacket()\n"
    )
    world = Team(tmp_path).world
    controllers = {"sender": sender, "listener": listener}
    with Simulation(world, mode="fast", controllers=controllers) as simulation:
        simulation.wait_for(lambda: "[listener] at 0.032 at 0.048" in simulation.console)
