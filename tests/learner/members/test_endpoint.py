"""Where a learner listens and whom a worker believes: what is open, what needs keys, what is refused."""

from __future__ import annotations

import logging
import stat
from datetime import UTC, datetime
from pathlib import Path

import pytest

from millrace.learner.config.config import Config
from millrace.learner.members.who_may_connect import generate_run_keys, join_lines, keyring_for
from millrace.protocol.address import advertised_address, check_address, is_local, needs_ipv6, own_address, resolves
from millrace.protocol.env_spec import AllowedCode, EnvSpec, PickledCallable
from millrace.protocol.errors import UsageError
from millrace.protocol.keys.key_folder import KeyFolder
from millrace.protocol.keys.keys import ClientList, Key, Token
from millrace.protocol.specs import StepSpec
from millrace.workers.allowed_code import allowed_code
from millrace.workers.conversation.connection_rules import checked_token

NOW = datetime(2026, 11, 21, 10, tzinfo=UTC)
TOKEN = Token(Key.new().public, Key.new())
PUBLIC = ["tcp://0.0.0.0:5555", "tcp://*:5555", "tcp://[::]:5555", "tcp://192.168.0.1:5555", "tcp://host:5555"]
LOOPBACK = ["tcp://127.0.0.1:5555", "tcp://localhost:5555", "tcp://[::1]:5555"]
INSIDE = ["ipc:///tmp/x", "inproc://x"]


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path))
    for variable in ("MILLRACE_KEYS", "MILLRACE_TOKEN"):
        monkeypatch.delenv(variable, raising=False)
    return tmp_path / ".config" / "millrace" / "keys"


# ---------------------------------------------------------------- the learner


@pytest.mark.parametrize("bind", PUBLIC)
def test_what_others_can_reach_has_keys_made_by_itself(home: Path, bind: str) -> None:
    keyring = keyring_for(Config(bind=bind), NOW)
    assert keyring is not None
    token = Token.from_text((home / "default.token").read_text(), "")
    assert token.server == keyring.key.public
    assert not keyring.rejection_reason(token.client.public)
    assert stat.S_IMODE(home.stat().st_mode) == 0o700
    again = keyring_for(Config(bind=bind), NOW)
    assert again is not None
    assert (again.key, again.allowed) == (keyring.key, keyring.allowed)


@pytest.mark.parametrize("bind", [*LOOPBACK, *INSIDE])
def test_what_this_machine_alone_can_reach_is_open_and_makes_no_files(home: Path, bind: str) -> None:
    assert keyring_for(Config(bind=bind), NOW) is None
    assert not home.exists()


@pytest.mark.parametrize("bind", LOOPBACK)
def test_on_loopback_keys_are_asked_for_where_a_folder_is_named(
    tmp_path: Path, bind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert keyring_for(Config(bind=bind, keys=str(tmp_path / "a")), NOW) is not None
    assert (tmp_path / "a" / "default.token").is_file()
    monkeypatch.setenv("MILLRACE_KEYS", str(tmp_path / "b"))
    assert keyring_for(Config(bind=bind), NOW) is not None
    assert (tmp_path / "b" / "default.token").is_file()


@pytest.mark.parametrize("bind", LOOPBACK)
def test_on_loopback_keys_are_made_if_workers_must_call_code_which_they_do_only_with_a_token(home: Path, bind: str) -> None:
    keyring = keyring_for(Config(bind=bind), NOW, calls_code=True)
    (line,) = join_lines(bind, "", keyring)
    assert line.endswith(f" --token {home}/default.token")
    token = Token.from_text((home / "default.token").read_text(), "")
    assert EnvSpec("CartPole-v1", wrappers=("mine:Clip",)).rejection_reason(allowed_code(bind, token)) == ""
    assert keyring_for(Config(bind=bind, insecure=True), NOW, calls_code=True) is None


def test_between_processes_that_share_a_file_there_are_no_keys(tmp_path: Path) -> None:
    for bind in INSIDE:
        assert keyring_for(Config(bind=bind, keys=str(tmp_path / "a")), NOW) is None


@pytest.mark.parametrize("bind", PUBLIC)
def test_insecure_is_spelt_out_and_says_what_it_risks(home: Path, bind: str, caplog: pytest.LogCaptureFixture) -> None:
    assert keyring_for(Config(bind=bind, insecure=True), NOW) is None
    (line,) = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert line.startswith(f"{bind} is open to anyone who can reach it, without keys")
    assert "--insecure" in line
    assert not home.exists()
    with pytest.raises(UsageError, match="expected one, got both"):
        keyring_for(Config(bind=bind, insecure=True, keys="k"), NOW)


def test_the_line_to_paste_is_the_whole_command(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("millrace.learner.members.who_may_connect.socket.gethostname", lambda: "gpu-box")
    keyring = keyring_for(Config(bind="tcp://0.0.0.0:5555"), NOW)
    first, second = join_lines("tcp://0.0.0.0:5555", "", keyring)
    assert first == "waiting for workers; start one with: millrace worker tcp://gpu-box:5555 --token default.token"
    assert f"the token is {home}/default.token: a secret; copy it" in second
    assert "tcp://10.1.2.3:5555 --token" in join_lines("tcp://0.0.0.0:5555", "10.1.2.3", keyring)[0]
    assert f"tcp://127.0.0.1:7 --token {home}/default.token" in join_lines("tcp://127.0.0.1:7", "", keyring)[0]
    assert join_lines("tcp://127.0.0.1:7", "", None) == [
        "waiting for workers; start one with: millrace worker tcp://127.0.0.1:7"
    ]
    assert join_lines("tcp://0.0.0.0:7", "", None)[0].endswith("millrace worker tcp://gpu-box:7 --insecure")
    KeyFolder(home).revoke("default", NOW)
    (line,) = join_lines("tcp://0.0.0.0:5555", "", keyring_for(Config(bind="tcp://0.0.0.0:5555"), NOW))
    assert "`millrace keys new NAME` makes one" in line
    for secret in (home / "server.key",):
        assert secret.read_text().strip() not in first + second + line


def test_throwaway_keys_fit_each_other_and_no_others() -> None:
    keyring, token = generate_run_keys("local", NOW)
    assert token.server == keyring.key.public
    assert not keyring.rejection_reason(token.client.public)
    assert keyring.rejection_reason(TOKEN.client.public)
    keyring.refresh()
    assert keyring.allowed != ClientList()


# ---------------------------------------------------------------- the worker


@pytest.mark.parametrize("address", ["tcp://192.168.0.1:5555", "tcp://host:5555", "tcp://[2001:db8::1]:5555"])
def test_a_worker_does_not_speak_with_just_anybody(address: str) -> None:
    with pytest.raises(UsageError, match=r"expected --token FILE \(or MILLRACE_TOKEN\), made there by `millrace keys new"):
        checked_token(address, None, insecure=False)
    assert checked_token(address, TOKEN, insecure=False) is TOKEN
    assert checked_token(address, None, insecure=True) is None
    with pytest.raises(UsageError, match="got both"):
        checked_token(address, TOKEN, insecure=True)


@pytest.mark.parametrize("address", LOOPBACK)
def test_on_loopback_a_token_is_used_if_there_is_one(address: str) -> None:
    assert checked_token(address, None, insecure=False) is None
    assert checked_token(address, TOKEN, insecure=False) is TOKEN


@pytest.mark.parametrize("address", INSIDE)
def test_a_socket_file_needs_no_token(address: str) -> None:
    assert checked_token(address, None, insecure=False) is None
    assert checked_token(address, TOKEN, insecure=False) is None, "the environment may hold one for other learners"


MODULE, CALLABLE = EnvSpec("os:Env-v0"), EnvSpec("mine", factory=PickledCallable(b"pickle"))
REGISTERED = [EnvSpec("CartPole-v1"), EnvSpec("ALE/Pong-v5"), EnvSpec("millrace/CartDoublePendulum-v0")]


def steps(*envs: EnvSpec) -> StepSpec:
    """A vector environment with a copy of each, all in one lane."""
    return StepSpec(envs, tuple(range(len(envs))), (len(envs),), (), ())


def test_a_worker_runs_as_much_code_as_it_is_sure_of_its_learner() -> None:
    levels = {
        allowed_code("tcp://host:5555", None): (False, False),
        allowed_code("tcp://127.0.0.1:5555", None): (True, False),
    }
    levels |= {allowed_code(address, TOKEN): (True, True) for address in (*PUBLIC, *LOOPBACK)}
    levels |= {allowed_code(address, None): (True, True) for address in INSIDE}
    assert set(levels) == set(AllowedCode)
    for code, (modules, callables) in levels.items():
        assert (MODULE.rejection_reason(code) == "") is modules
        assert (CALLABLE.rejection_reason(code) == "") is callables
        assert not any(env.rejection_reason(code) for env in REGISTERED)
        assert not steps(*REGISTERED).rejection_reason(code)
        assert steps(*REGISTERED, MODULE).rejection_reason(code) == MODULE.rejection_reason(code)
        assert steps(REGISTERED[0], CALLABLE).rejection_reason(code) == CALLABLE.rejection_reason(code)


# ---------------------------------------------------------------- addresses


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("tcp://::1:5555", r"expected an IPv6 address in brackets, as in tcp://\[::1\]:5555"),
        ("tcp://[::1:5555", "expected an IPv6 address in brackets"),
        ("tcp://[localhost]:5555", "expected an IPv6 address in brackets"),
        ("tcp://:5555", "expected a host before the port"),
        ("tcp://a b:5555", "expected a host name or an IP address, got a b"),
        ("tcp://user@host:5555", "expected a host name"),
        ("tcp://$(touch${IFS}x):5555", "expected a host name"),
        ("tcp://`id`:5555", "expected a host name"),
        ("tcp://a&b:5555", "expected a host name"),
        ("tcp://a'b:5555", "expected a host name"),
        ("tcp://host/path:5555", "expected a host name"),
        ("tcp://[::1]", "expected a port"),
        ("tcp://host:٥", "expected a port"),
        ("ipc:///tmp/a\0b", r"address ipc:///tmp/a\\x00b: expected text without control characters"),
        ("tcp://a\udc80:5555", r"address tcp://a\\udc80:5555: expected text without control characters"),
    ],
)
def test_an_address_that_is_misspelt_says_how_it_should_be(address: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        check_address(address)


@pytest.mark.parametrize(
    "address", [*PUBLIC, *LOOPBACK, *INSIDE, "tcp://[fe80::1%eth0]:1", "tcp://my-host.example.com:65535"]
)
def test_an_address_that_is_right_passes(address: str) -> None:
    assert check_address(address) == address


def test_what_looks_like_this_machine_and_is_not_is_not_local() -> None:
    for address in ("tcp://localhost.:1", "tcp://127.0.0.1.example.com:1", "tcp://0.0.0.0:1", "tcp://[::ffff:10.0.0.1]:1"):
        assert not is_local(address)


def test_ipv6_is_used_for_addresses_and_not_for_names_that_have_another() -> None:
    assert needs_ipv6("tcp://[::1]:5555")
    assert not needs_ipv6("tcp://localhost:5555")
    for address in ("tcp://127.0.0.1:5555", "tcp://*:5555", "ipc:///tmp/x", "tcp://no.such.host.invalid:1"):
        assert not needs_ipv6(address)
    assert not resolves("tcp://no.such.host.invalid:1")
    for name in "a..b", "x" * 70 + ".com":  # no names of hosts
        assert not resolves(f"tcp://{name}:1")
        assert not needs_ipv6(f"tcp://{name}:1")
    assert resolves("tcp://localhost:1")
    assert resolves("ipc:///tmp/x")


@pytest.mark.parametrize(
    ("bound", "advertise", "typed"),
    [
        ("tcp://0.0.0.0:5555", "", "tcp://box:5555"),
        ("tcp://[::]:5555", "", "tcp://box:5555"),
        ("tcp://0.0.0.0:5555", "10.0.0.7", "tcp://10.0.0.7:5555"),
        ("tcp://0.0.0.0:5555", "2001:db8::1", "tcp://[2001:db8::1]:5555"),
        ("tcp://0.0.0.0:5555", "[2001:db8::1]", "tcp://[2001:db8::1]:5555"),
        ("tcp://192.168.0.1:5555", "", "tcp://192.168.0.1:5555"),
        ("tcp://[::1]:5555", "", "tcp://[::1]:5555"),
        ("ipc:///tmp/x", "ignored", "ipc:///tmp/x"),
    ],
)
def test_what_others_type_to_reach_it(bound: str, advertise: str, typed: str) -> None:
    assert advertised_address(bound, advertise, "box") == typed


@pytest.mark.parametrize(
    ("bound", "own"),
    [
        ("tcp://0.0.0.0:5555", "tcp://127.0.0.1:5555"),
        ("tcp://[::ffff:0.0.0.0]:5555", "tcp://127.0.0.1:5555"),
        ("tcp://[::]:5555", "tcp://[::1]:5555"),
        ("tcp://192.168.0.1:5555", "tcp://192.168.0.1:5555"),
        ("ipc:///tmp/x", "ipc:///tmp/x"),
    ],
)
def test_what_its_own_machine_types_to_reach_it(bound: str, own: str) -> None:
    assert own_address(bound) == own
