"""Signatures, with pymavlink's own signer and checker at the other end."""

import base64
import itertools
import json
import re
import socket
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav

from drivers.mavlink.endpoint import Endpoint
from drivers.mavlink.link import UdpLink, open_link
from drivers.mavlink.options import LinkOptions
from drivers.mavlink.signing import BEHIND_S, EPOCH_S, TICKS, Signer, read_key
from drivers.mavlink.station import Identity, Station
from drivers.mavlink.store import Store, state_folder
from nav.errors import HilError

KEY = bytes(range(32))
NOW_S = 1_800_000_000.0


def signer(tmp_path: Path, *unsigned: str, now_s: float = NOW_S) -> Signer:
    return Signer(KEY, Store(tmp_path / "state" / "times.json"), unsigned, lambda: now_s)


def peer(key: bytes = KEY, now_s: float = NOW_S, link_id: int = 3) -> mav.MAVLink:
    made = mav.MAVLink(None, 255, 190)
    made.signing.secret_key, made.signing.sign_outgoing, made.signing.link_id = key, True, link_id
    made.signing.timestamp = int((now_s - EPOCH_S) * TICKS)
    return made


def unsigned_peer() -> mav.MAVLink:
    return mav.MAVLink(None, 255, 190)


def beat() -> Any:
    return mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)


def parsed(frame: bytes) -> Any:
    (message,) = mav.MAVLink(None).parse_buffer(frame)
    return message


def ours() -> mav.MAVLink:
    return mav.MAVLink(None, 1, 1)


def stamp_of(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


def test_a_peer_accepts_what_we_sign_and_refuses_it_when_changed(tmp_path: Path) -> None:
    ours_, checker, sign = ours(), peer(), signer(tmp_path)
    for _ in range(3):
        sign.sign(ours_, 7)
        frame = bytes(beat().pack(ours_))
        (message,) = checker.parse_buffer(frame)
        assert message.get_signed()
    sign.sign(ours_, 7)
    frame = bytearray(beat().pack(ours_))
    frame[-1] ^= 1
    with pytest.raises(mav.MAVError, match="signature"):
        checker.parse_buffer(frame)


def test_we_accept_what_a_peer_signs(tmp_path: Path) -> None:
    sign, client = signer(tmp_path), peer()
    assert [sign.refusal(parsed(beat().pack(client))) for _ in range(3)] == ["", "", ""]


def test_a_replayed_frame_is_refused_on_any_link_and_after_a_restart(tmp_path: Path) -> None:
    sign, client = signer(tmp_path), peer()
    first, second = bytes(beat().pack(client)), bytes(beat().pack(client))
    assert sign.refusal(parsed(second)) == ""
    assert sign.refusal(parsed(second)) == "replayed"
    assert sign.refusal(parsed(first)) == "replayed"
    sign.close()
    again = signer(tmp_path)
    assert again.refusal(parsed(second)) == "replayed"
    assert again.refusal(parsed(bytes(beat().pack(client)))) == ""


@pytest.mark.parametrize("key", [bytes(32), KEY[::-1]])
def test_another_key_is_refused_and_its_time_is_not_taken_over(tmp_path: Path, key: bytes) -> None:
    sign = signer(tmp_path)
    forged = bytes(beat().pack(peer(key, NOW_S + 1e6)))
    assert sign.refusal(parsed(forged)) == "wrong signature"
    assert sign.refusal(parsed(beat().pack(peer()))) == ""  # the forger has silenced nobody
    packer = ours()
    sign.sign(packer, 0)
    assert packer.signing.timestamp < (NOW_S + 10.0 - EPOCH_S) * TICKS


def test_an_unknown_stream_may_be_a_minute_behind(tmp_path: Path) -> None:
    sign = signer(tmp_path)
    assert sign.refusal(parsed(beat().pack(peer(now_s=NOW_S - BEHIND_S - 1.0)))) == "too old"
    assert sign.refusal(parsed(beat().pack(peer(now_s=NOW_S - BEHIND_S + 5.0)))) == ""


def test_a_right_signature_from_the_future_moves_our_time(tmp_path: Path) -> None:
    sign, packer = signer(tmp_path), ours()
    assert sign.refusal(parsed(beat().pack(peer(now_s=NOW_S + 1000.0)))) == ""
    sign.sign(packer, 0)
    assert packer.signing.timestamp > (NOW_S + 1000.0 - EPOCH_S) * TICKS


def test_unsigned_messages_are_refused_but_the_exceptions(tmp_path: Path) -> None:
    sign, plain = signer(tmp_path, "RADIO_STATUS"), unsigned_peer()
    radio = mav.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7)
    assert sign.refusal(parsed(beat().pack(plain))) == "unsigned"
    assert sign.refusal(parsed(beat().pack(plain, force_mavlink1=True))) == "unsigned"
    assert sign.refusal(parsed(radio.pack(plain))) == ""
    assert sign.refusal(parsed(radio.pack(plain, force_mavlink1=True))) == ""
    assert sign.refusal(parsed(radio.pack(peer(bytes(32))))) == "wrong signature"
    with pytest.raises(HilError, match="unknown message 'NO_SUCH'"):
        signer(tmp_path, "NO_SUCH")


@given(steps=st.lists(st.floats(-1e8, 1e8), min_size=1, max_size=8), killed=st.lists(st.booleans(), min_size=8))
def test_our_time_rises_whatever_the_clock_and_the_end(
    tmp_path_factory: pytest.TempPathFactory, steps: list[float], killed: list[bool]
) -> None:
    """The clock steps from run to run and within one; a killed run keeps nothing at its end."""
    folder, stamps, now = tmp_path_factory.mktemp("times"), [], [NOW_S]
    for step, dies in zip(steps, killed, strict=False):
        sign = Signer(KEY, Store(folder / "times.json"), (), lambda: now[0])
        packer = ours()
        for shift in (0.0, step, 0.0, 7.0):
            now[0] = max(now[0] + shift, EPOCH_S + 1.0)
            sign.sign(packer, 0)
            stamps.append(stamp_of(bytes(beat().pack(packer))))
        if not dies:
            sign.close()
    assert all(a < b for a, b in itertools.pairwise(stamps))


def test_two_programs_do_not_lose_each_others_streams(tmp_path: Path) -> None:
    one, other = signer(tmp_path), signer(tmp_path)
    first, second = parsed(beat().pack(peer(link_id=1))), parsed(beat().pack(peer(link_id=2)))
    assert (one.refusal(first), other.refusal(second)) == ("", "")
    one.close()
    other.close()
    again = signer(tmp_path)
    assert (again.refusal(first), again.refusal(second)) == ("replayed", "replayed")


@pytest.mark.parametrize(
    "content",
    [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n", base64.b64encode(KEY) + b"\n"],
    ids=["bytes", "hex", "HEX", "base64"],
)
def test_a_key_is_read_in_every_form(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "key"
    path.write_bytes(content)
    path.chmod(0o600)
    assert read_key(path) == KEY


@pytest.mark.parametrize(
    ("content", "mode", "says"),
    [
        (KEY, 0o644, "chmod 600"),
        (KEY, 0o620, "chmod 600"),
        (b"secret-secret", 0o600, "expected 32 bytes"),
        (b"", 0o600, "expected 32 bytes"),
        (KEY[:31], 0o600, "expected 32 bytes"),
        (None, 0o600, "No such file"),
    ],
)
def test_a_wrong_key_file_is_explained_and_never_shown(tmp_path: Path, content: Any, mode: int, says: str) -> None:
    path = tmp_path / "key"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    with pytest.raises(HilError, match=re.escape(says)) as caught:
        read_key(path)
    assert str(path) in str(caught.value)
    assert "secret-secret" not in str(caught.value)


def test_times_that_are_damaged_are_explained(tmp_path: Path) -> None:
    path = tmp_path / "state" / "times.json"
    path.parent.mkdir()
    for text in ("{", "[]", '{"ticks": "x"}', '{"streams": 3}'):
        path.write_text(text)
        with pytest.raises(HilError, match=r"times\.json"):
            signer(tmp_path)


def test_the_times_are_for_their_owner_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    signer(tmp_path).close()
    path = tmp_path / "state" / "times.json"
    assert path.stat().st_mode & 0o077 == 0
    assert KEY.hex() not in path.read_text()
    assert set(json.loads(path.read_text())) == {"ticks", "streams"}
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_folder() == tmp_path / "dtg-hil"


class Signed:
    """An endpoint that wants signatures, on UDP, and a client."""

    def __init__(self, tmp_path: Path, **options: Any) -> None:
        self.link: Any = open_link("udpin:127.0.0.1:0")
        assert isinstance(self.link, UdpLink)
        self.station = Station(Identity(), {}, lambda lat, lon: 0.0, print)
        url = LinkOptions("udpin:127.0.0.1:0", **options)
        self.endpoint = Endpoint(self.station, self.link, url, signer(tmp_path, "RADIO_STATUS"))
        self.now_s = 0.0

    def client(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.connect(("127.0.0.1", self.link.port))
        made.settimeout(0.5)
        return made

    def hear(self, client: socket.socket, frame: bytes) -> None:
        client.send(frame)
        self.now_s += 1.0
        self.endpoint.poll(self.now_s)


def test_only_the_owner_of_the_key_is_answered_and_obeyed(tmp_path: Path) -> None:
    signed = Signed(tmp_path)
    stranger, friend = signed.client(), signed.client()
    setting = mav.MAVLink_param_set_message(1, 1, b"SR_ATT_HZ", 5.0, mav.MAV_PARAM_TYPE_REAL32)
    for frame in (setting.pack(unsigned_peer()), setting.pack(peer(bytes(32)))):
        signed.hear(stranger, bytes(frame))
    assert signed.station.interval_s("ATTITUDE") == 1.0 / 50.0
    with pytest.raises(TimeoutError):  # a stranger gets nothing, so he cannot push the others out either
        stranger.recv(100)
    assert signed.endpoint.refused == {"unsigned": 1, "wrong signature": 1}
    assert signed.endpoint.received.total() == signed.endpoint.bad_data == 0
    notes = [text for _, text in signed.station.notes]
    assert notes == [f"MAVLink from system 255 is refused: {why}" for why in ("unsigned", "wrong signature")]

    client = peer()
    frame = bytes(setting.pack(client))
    signed.hear(friend, frame)
    assert signed.station.interval_s("ATTITUDE") == 1.0 / 5.0
    checker = peer()
    assert checker.parse_buffer(friend.recv(500))[0].get_signed()
    signed.station.parameters.write("SR_ATT_HZ", 50.0, mav.MAV_PARAM_TYPE_REAL32)
    signed.hear(stranger, frame)  # recorded and sent again
    assert signed.station.interval_s("ATTITUDE") == 1.0 / 50.0
    assert signed.endpoint.refused["replayed"] == 1


def test_a_link_may_go_without_signatures(tmp_path: Path) -> None:
    signed = Signed(tmp_path, sign=False)
    client = signed.client()
    signed.hear(client, bytes(beat().pack(unsigned_peer())))
    assert signed.endpoint.received["HEARTBEAT"] == 1
    assert not unsigned_peer().parse_buffer(client.recv(500))[0].get_signed()


def test_no_key_is_taken_from_the_network(tmp_path: Path) -> None:
    signed = Signed(tmp_path)
    client, friend = peer(), signed.client()
    signed.hear(friend, bytes(mav.MAVLink_setup_signing_message(1, 1, bytes(32), 0).pack(client)))
    assert "from a file" in signed.station.notes[-1][1]
    signed.hear(friend, bytes(beat().pack(client)))  # the old key still holds
    assert signed.endpoint.received["HEARTBEAT"] == 1
