"""Speaking to Webots' WebSocket: obeyed or not, silent, huge, broken."""

from __future__ import annotations

import socket
import threading
import time
from importlib import metadata
from typing import get_args

import pytest

from tests.simulator.webots_server import WebotsServer
from webots_mcp.contract import host_name
from webots_mcp.errors import CommandRefusedError
from webots_mcp.simulator.orders import (
    MAX_MESSAGE_BYTES,
    Order,
    Stream,
    WebotsAddress,
    WebotsLine,
    address_of,
    begin_console,
    connected,
    console_lines,
    give_order,
    load_world,
    why_not_obeyed,
)

_CUTS_OFF = pytest.mark.skipif(
    int(metadata.version("websockets").partition(".")[0]) < 17,
    reason="the server of websockets before 17 answers the ping before it is cut off",
)


def at(server: WebotsServer) -> WebotsAddress:
    return WebotsAddress("127.0.0.1", server.port)


@pytest.mark.parametrize(
    ("order", "sent", "heard"),
    [
        ("pause", "pause", "paused by client"),
        ("resume", "real-time:-1", "real-time"),
        ("fast", "fast:-1", "fast"),
        ("step", "step", "paused by client"),
        ("reload", "reload", "delete world"),
    ],
)
def test_with_stream_webots_obeys_and_its_words_are_heard(
    order: Order, sent: str, heard: str
) -> None:
    with WebotsServer(streams=True) as server:
        reply = give_order(at(server), order)
        assert (reply.text, server.heard) == (heard, [sent])


def test_another_world_of_the_folder_is_loaded() -> None:
    with WebotsServer(streams=True) as server:
        assert load_world(at(server), "maze.wbt").text == "delete world"
        assert server.heard == ["load:maze.wbt"]


def test_a_reset_may_be_obeyed_without_a_word() -> None:
    with WebotsServer(streams=True) as server:
        reply = give_order(at(server), "reset", 0.2)
        assert (reply.text, reply.is_alive, server.heard) == (None, True, ["reset"])


@pytest.mark.slow
def test_without_stream_it_is_said_that_webots_hears_but_does_not_obey() -> None:
    with WebotsServer(streams=False) as server:
        for order in get_args(Order):
            reply = give_order(at(server), order, 0.3)
            assert reply.text is None
            assert "was started without --stream" in why_not_obeyed(at(server), reply)
            assert "busy" not in why_not_obeyed(at(server), reply)
        assert server.mode == "pause"


def test_an_answer_that_is_not_known_is_told_and_is_no_sign_of_a_start_without_stream() -> None:
    with WebotsServer(streams=True, manner="in other words") as server:
        reply = give_order(at(server), "pause", 5)
        told = why_not_obeyed(at(server), reply)
        assert (reply.text, server.mode) == (None, "pause")
        assert "answered 'state: changed', which does not show whether it obeyed" in told
        assert "--stream" not in told


def test_the_words_that_pause_by_accident_are_never_sent() -> None:
    with WebotsServer(streams=True) as server:
        for order in get_args(Order):
            give_order(at(server), order, 0.2)
        with connected(at(server), 1) as stream:
            begin_console(stream)
        assert not {"w3d", "x3d"} & set(server.heard)


@pytest.mark.slow
def test_a_busy_main_thread_is_one_of_the_reasons_and_nothing_takes_longer_than_asked() -> None:
    with WebotsServer(streams=True, manner="busy") as server:
        began_s = time.monotonic()
        reply = give_order(at(server), "pause", 0.3)
        assert time.monotonic() - began_s < 0.3 + 2  # the machine may be slow, Webots is not asked
        assert "its main thread is busy and may still obey later" in why_not_obeyed(
            at(server), reply
        )


def test_who_listens_but_never_shakes_hands_is_told_apart_from_nobody() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = WebotsAddress("127.0.0.1", silent.getsockname()[1])
        with pytest.raises(CommandRefusedError, match=r"did not answer within 0\.1 s"):
            give_order(address, "pause", 0.1)
    with pytest.raises(CommandRefusedError, match="no Webots listens"):
        give_order(address, "pause", 0.1)


def test_another_program_at_the_port_is_no_webots() -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:
        address = WebotsAddress("127.0.0.1", door.getsockname()[1])

        def answer() -> None:
            with door.accept()[0] as client:
                client.recv(4096)
                client.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(CommandRefusedError, match="is not Webots"):
            give_order(address, "pause", 5)
        thread.join()


def test_who_hangs_up_in_the_handshake_is_no_webots() -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:

        def hang_up() -> None:
            with door.accept()[0] as client:
                client.recv(4096)

        thread = threading.Thread(target=hang_up)
        thread.start()
        with pytest.raises(CommandRefusedError, match="is not Webots"):
            give_order(WebotsAddress("127.0.0.1", door.getsockname()[1]), "pause", 5)
        thread.join()


@_CUTS_OFF
def test_a_connection_that_ends_in_mid_frame_is_an_error_with_a_reason() -> None:
    with (
        WebotsServer(streams=True, manner="cut off") as server,
        pytest.raises(CommandRefusedError, match=r"closed the connection|broke"),
    ):
        give_order(at(server), "pause", 5)


def test_a_huge_message_is_read_and_thrown_away() -> None:
    size = 64 << 20
    with WebotsServer(streams=True, announce_bytes=size) as server:
        with connected(at(server), 5) as stream:
            stream.send("fast:-1")
            first = stream.receive(time.monotonic() + 60)
            second = stream.receive(time.monotonic() + 60)
        assert first is not None and second is not None
        assert len(first.text) == MAX_MESSAGE_BYTES
        assert first.dropped_bytes == size + len("model:") - MAX_MESSAGE_BYTES
        assert (second.text, second.dropped_bytes) == ("fast", 0)


def test_the_console_is_told_without_stream_from_its_first_line_on() -> None:
    with WebotsServer(streams=False) as server:
        server.log("stdout", "INFO: rover: Starting controller: python3 -u rover.py")
        server.log("stderr", "Traceback\n")
        server.log("stderr", "  in loop\n")
        with connected(at(server), 5) as stream:
            begin_console(stream)
            assert _next_lines(stream) == [
                WebotsLine("stdout", "INFO: rover: Starting controller: python3 -u rover.py"),
                WebotsLine("stderr", "Traceback"),
                WebotsLine("stderr", "  in loop"),
            ]
            server.log("stdout", "later\n")
            assert _next_lines(stream) == [WebotsLine("stdout", "later")]


def _next_lines(stream: Stream) -> list[WebotsLine]:
    message = stream.receive(time.monotonic() + 20)
    assert message is not None
    return list(console_lines(message.text))


def test_what_is_no_console_is_none() -> None:
    assert list(console_lines('application/json:{"time":12}\nstdout:no')) == []
    assert list(console_lines("paused by client")) == []
    assert list(console_lines("stdout:a:b\n\nstderr:")) == [
        WebotsLine("stdout", "a:b"),
    ]
    assert list(console_lines("stderr:two\nlines")) == [
        WebotsLine("stderr", "two"),
        WebotsLine("stderr", "lines"),
    ]


def test_a_session_tells_where_its_webots_listens() -> None:
    assert address_of(f"{host_name()}:1234") == WebotsAddress("127.0.0.1", 1234)
    assert address_of("192.168.1.5:1235") == WebotsAddress("192.168.1.5", 1235)
    for unknown in (f"{host_name()} process 12", f"{host_name()}:/tmp/x", "a:0", "a:99999", ""):
        assert address_of(unknown) is None
