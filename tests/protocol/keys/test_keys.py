"""Keys, tokens and the list of clients: what is damaged is named, what is secret stays so, what is revoked is out."""

from __future__ import annotations

import os
import stat
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from millrace.protocol.errors import UsageError
from millrace.protocol.keys.key_folder import KeyFolder, Keyring, chosen_key_folder
from millrace.protocol.keys.keys import (
    TOKEN_CHARACTERS,
    TOKEN_PREFIX,
    Client,
    ClientList,
    Key,
    Token,
    fingerprint,
    public_key,
)
from millrace.protocol.keys.worker_token import TOKEN_VARIABLE, read_token
from millrace.protocol.logs.log_rate_limiter import LogRateLimiter

NOW = datetime(2026, 11, 21, 10, tzinfo=UTC)
LATER = datetime(2026, 11, 22, 10, tzinfo=UTC)
SERVER, LAB, HOME = Key.new(), Key.new(), Key.new()
TOKEN = Token(SERVER.public, LAB)
TEXT = TOKEN.to_text()


def refusal(text: str) -> str:
    with pytest.raises(UsageError) as caught:
        Token.from_text(text, "token x")
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith("token x")
    return line


# ---------------------------------------------------------------- tokens


def test_a_token_says_whom_to_believe_and_who_one_is() -> None:
    assert Token.from_text(TEXT, "") == TOKEN
    assert Token.from_text(f"  {TEXT}\n", "") == TOKEN
    assert len(TEXT) == TOKEN_CHARACTERS
    assert TEXT.isascii()
    assert TEXT.isprintable()
    assert not set(TEXT) & set(" '\"$!&;<>()[]{}*?\\|`#~=/")  # nothing that a shell would take for its own


@given(st.binary(min_size=32, max_size=32), st.binary(min_size=32, max_size=32))
def test_any_two_keys_make_a_token(server: bytes, secret: bytes) -> None:
    found = Token.from_text(Token(server, Key(b"", secret)).to_text(), "")
    assert (found.server, found.client.secret) == (server, secret)


def test_a_token_that_was_cut_short_is_named_as_such() -> None:
    for length in range(len(TOKEN_PREFIX), len(TEXT)):
        assert f"cut short: expected 101 characters, got {length}" in refusal(TEXT[:length])
    assert "too long" in refusal(TEXT + "A")


def test_no_one_character_of_a_token_can_be_another() -> None:
    for at in range(len(TOKEN_PREFIX), len(TEXT)):
        for other in "A0_":
            if TEXT[at] != other:
                assert "damaged (its checksum does not fit)" in refusal(TEXT[:at] + other + TEXT[at + 1 :])


def test_what_is_no_token_is_told_from_a_damaged_one() -> None:
    assert "is empty" in refusal(" \n")
    assert "got something else" in refusal("hunter2")
    assert "got one of version 2; install the learner's version" in refusal("millrace2.abc")
    assert "in one line and nothing else, got 2 words" in refusal(TEXT[:50] + "\n" + TEXT[50:])
    assert "damaged" in refusal(TEXT[:-1] + "*")
    assert "cut short" in refusal(TEXT[:50] + "é")


def test_no_error_and_no_repr_holds_a_secret() -> None:
    halves = (LAB.secret.hex(), repr(LAB.secret), TEXT[60:])
    said = [repr(LAB), repr(TOKEN), str(TOKEN), refusal(TEXT[:-1]), refusal(TEXT + "A"), refusal(TEXT.swapcase())]
    said += [refusal(f"{TEXT} {TEXT}"), fingerprint(LAB.public)]
    with pytest.raises(UsageError) as caught:
        public_key(TEXT, "keys allow")
    assert "got a join token, which is secret" in str(caught.value)
    for line in [*said, str(caught.value)]:
        assert not [half for half in halves if half in line]


def test_a_public_key_is_that_of_its_secret() -> None:
    assert Key.from_secret(LAB.secret) == LAB
    assert Key.new() != Key.new()
    assert public_key(LAB.public.hex(), "") == LAB.public
    for wrong in ("", "abc", "zz" * 32, LAB.public.hex()[:-2], LAB.public.hex() + "00", " " + LAB.public.hex()):
        with pytest.raises(UsageError, match="expected a public key of 64 hexadecimal digits"):
            public_key(wrong, "x")


# ---------------------------------------------------------------- who may connect


def both() -> ClientList:
    return ClientList().with_client("lab", LAB.public, NOW).with_client("home", HOME.public, NOW)


def test_who_is_not_on_the_list_may_nothing() -> None:
    assert ClientList().rejection_reason(LAB.public)
    assert both().rejection_reason(LAB.public) == both().rejection_reason(HOME.public) == ""
    assert both().rejection_reason(SERVER.public) == f"its key {fingerprint(SERVER.public)} is not allowed here"
    for wrong in (b"", LAB.public[:-1], LAB.public + b"\0", LAB.secret):
        assert both().rejection_reason(wrong)


def test_who_is_revoked_is_out_and_nobody_else() -> None:
    after = both().with_revoked("lab", LATER)
    assert after.rejection_reason(LAB.public) == f"its key lab ({fingerprint(LAB.public)}) was revoked"
    assert not after.rejection_reason(HOME.public)
    assert after.names() == ["home"]
    again = after.with_client("lab", SERVER.public, LATER)  # the name is free, the key is not
    assert not again.rejection_reason(SERVER.public)
    assert again.rejection_reason(LAB.public)
    with pytest.raises(UsageError, match="was revoked, which is final"):
        after.with_client("other", LAB.public, LATER)


def test_a_key_that_stands_twice_is_out_if_it_was_revoked_once() -> None:
    twice = ClientList((Client("a", LAB.public.hex(), NOW), Client("b", LAB.public.hex(), NOW, revoked=LATER)))
    assert "was revoked" in twice.rejection_reason(LAB.public)


def test_a_name_and_a_key_are_given_once() -> None:
    with pytest.raises(UsageError, match="key lab exists already"):
        both().with_client("lab", SERVER.public, NOW)
    with pytest.raises(UsageError, match=r"\(lab\) is allowed already"):
        both().with_client("other", LAB.public, NOW)
    with pytest.raises(UsageError, match="key x: no key has this name; those that may connect: lab, home"):
        both().with_revoked("x", NOW)
    with pytest.raises(UsageError, match="revoked already"):
        both().with_revoked("lab", NOW).with_revoked("lab", NOW)


@pytest.mark.parametrize("name", ["", "../lab", "a/b", ".hidden", "a b", "é", "x" * 65, "a\0", "-a"])
def test_a_name_is_part_of_a_file_name_and_no_path(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="expected 1 to 64 letters"):
        both().with_client(name, SERVER.public, NOW)
    with pytest.raises(UsageError, match="expected 1 to 64 letters"):
        KeyFolder(tmp_path).token_path(name)


def test_the_list_is_text_and_back() -> None:
    for allowed in (ClientList(), both(), both().with_revoked("lab", LATER)):
        assert ClientList.from_toml(allowed.to_toml(), "") == allowed
    assert LAB.secret.hex() not in both().to_toml()


@pytest.mark.parametrize(
    "text",
    [
        "client = 3",
        "[[client]]\nname = 'a'",
        "[[client]]\nname = 'a'\npublic = 'zz'\nmade = 2026-11-21T10:00:00Z",
        "[[client]]\nname = '../a'\npublic = '" + "00" * 32 + "'\nmade = 2026-11-21T10:00:00Z",
        "[[client]]\nname = 'a'\npublic = '" + "00" * 32 + "'\nmade = 2026-11-21T10:00:00Z\nrevokd = 1",
        "[[clients]]\nname = 'a'",
        "not toml",
        "client = " + "[" * 10_000,
        "client = 1" + "0" * 10_000,
    ],
)
def test_a_list_that_is_not_understood_is_no_list(text: str) -> None:
    with pytest.raises(UsageError, match=r"^list x"):
        ClientList.from_toml(text, "list x")


# ---------------------------------------------------------------- files


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[KeyFolder]:
    before = os.umask(0)  # nothing but our own care makes files private
    yield KeyFolder(tmp_path / "deep" / "keys")
    os.umask(before)


def modes(folder: KeyFolder) -> dict[str, int]:
    return {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.path.iterdir()}


def test_every_file_is_made_private_and_not_made_so_later(folder: KeyFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[int] = []
    real = os.open

    def watched(path: str, flags: int, mode: int = 0o777, **rest: int) -> int:
        if flags & os.O_CREAT:
            assert flags & os.O_EXCL
            opened.append(mode)
        return real(path, flags, mode, **rest)

    monkeypatch.setattr(os, "open", watched)
    for name in ("chmod", "fchmod"):
        monkeypatch.delattr(os, name)
    folder.ensure_first_client(NOW)
    folder.new("lab", NOW)
    assert stat.S_IMODE(folder.path.stat().st_mode) == 0o700
    assert modes(folder) == dict.fromkeys(("server.key", "allowed.toml", "default.token", "lab.token"), 0o600)
    assert set(opened) == {0o600}


def test_the_learners_key_is_made_once(folder: KeyFolder) -> None:
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(KeyFolder(folder.path).server().secret)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert len(found) == 8
    assert set(found) == {folder.server().secret}
    assert [path.name for path in folder.path.iterdir()] == ["server.key"]


def test_two_commands_at_once_lose_nothing(folder: KeyFolder) -> None:
    folder.server()
    threads = [threading.Thread(target=folder.new, args=(f"n{i}", NOW)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert sorted(folder.allowed().names()) == [f"n{i}" for i in range(8)]


def test_a_token_opens_the_learner_that_made_it(folder: KeyFolder) -> None:
    allowed = folder.ensure_first_client(NOW)
    token = Token.from_text(folder.token_path("default").read_text(), "")
    assert token.server == folder.server().public
    assert not allowed.rejection_reason(token.client.public)
    assert allowed.clients[0].made == NOW
    assert folder.ensure_first_client(LATER) == allowed, "there was a first client already"


def test_revoking_deletes_the_token_and_makes_no_new_first_client(folder: KeyFolder) -> None:
    folder.ensure_first_client(NOW)
    folder.revoke("default", LATER)
    assert not folder.token_path("default").exists()
    assert folder.ensure_first_client(LATER).names() == []


def test_a_client_may_keep_its_secret_to_itself(folder: KeyFolder, tmp_path: Path) -> None:
    elsewhere = KeyFolder(tmp_path / "elsewhere")
    path, public = elsewhere.new_for_other_learner("lab", folder.server().public)
    folder.allow("lab", public, NOW)
    token = Token.from_text(path.read_text(), "")
    assert not folder.allowed().rejection_reason(token.client.public)
    assert token.server == folder.server().public
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert not folder.token_path("lab").exists()
    with pytest.raises(UsageError, match="is there already"):
        elsewhere.new_for_other_learner("lab", folder.server().public)


def test_what_others_can_read_is_not_used(folder: KeyFolder) -> None:
    folder.ensure_first_client(NOW)
    for name, what in (
        ("server.key", folder.server),
        ("default.token", lambda: read_token(str(folder.token_path("default")))),
    ):
        for mode in (0o640, 0o604, 0o620):
            (folder.path / name).chmod(mode)
            with pytest.raises(UsageError, match=rf"{name} can be read by others \(mode {mode:04o}\); chmod 600 "):
                what()
        (folder.path / name).chmod(0o400)
        what()
    folder.list_path.chmod(0o646)
    with pytest.raises(UsageError, match="can be written by others"):
        folder.allowed()
    folder.path.chmod(0o750)
    with pytest.raises(UsageError, match="can be entered by others"):
        folder.server()


@pytest.mark.parametrize("text", ["", "abc", "00" * 31, "zz" * 32])
def test_a_damaged_key_is_not_replaced(folder: KeyFolder, text: str) -> None:
    folder.server()
    (folder.path / "server.key").write_text(text)
    with pytest.raises(UsageError, match=r"server.key is damaged: expected 64 hexadecimal digits"):
        folder.server()
    assert (folder.path / "server.key").read_text() == text


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "keys"):
        with pytest.raises(UsageError, match="key folder"):
            KeyFolder(path).server()


def test_a_folder_in_the_place_of_a_token_is_one_line_and_leaves_no_secret_behind(folder: KeyFolder) -> None:
    folder.server()
    folder.token_path("lab").mkdir()
    with pytest.raises(UsageError, match=r"^key file .*lab.token cannot be written: Is a directory$"):
        folder.new("lab", NOW)
    assert sorted(path.name for path in folder.path.iterdir()) == ["lab.token", "server.key"]


def test_a_file_system_without_hard_links_is_one_line(folder: KeyFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    with pytest.raises(UsageError, match=r"^key file .*server.key cannot be written: Operation not permitted$"):
        folder.server()
    assert list(folder.path.iterdir()) == []


def test_a_home_folder_that_is_not_known_is_one_line() -> None:
    for use in (lambda: chosen_key_folder("~nobody.here/keys"), lambda: read_token("~nobody.here/lab.token")):
        with pytest.raises(UsageError, match=r" ~nobody.here/.*: this home folder is not known here; give the whole path$"):
            use()


def test_a_token_in_the_environment_that_is_too_long_is_named_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, TEXT + 300 * "A")
    with pytest.raises(UsageError, match="the join token is too long: expected 101 characters, got 401"):
        read_token("")


def test_half_a_file_is_never_seen(folder: KeyFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.ensure_first_client(NOW)
    before = folder.list_path.read_text()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UsageError, match="cannot be written: No space left"):
        folder.revoke("default", NOW)
    assert folder.list_path.read_text() == before
    assert not [path for path in folder.path.iterdir() if path.name.startswith(".")]


# ---------------------------------------------------------------- a list that changes


def test_a_list_that_changes_is_read_again(folder: KeyFolder) -> None:
    ring = Keyring(folder.server(), folder.ensure_first_client(NOW), folder)
    lab = Token.from_text(folder.new("lab", NOW).read_text(), "").client.public
    assert ring.rejection_reason(lab)
    ring.refresh()
    assert not ring.rejection_reason(lab)
    folder.revoke("lab", LATER)
    ring.refresh()
    assert "was revoked" in ring.rejection_reason(lab)
    assert "was revoked" in ring.allowed.rejection_reason(lab)


def test_who_reads_a_list_never_waits_for_a_fifo_in_its_place(folder: KeyFolder) -> None:
    folder.path.mkdir(parents=True, exist_ok=True)
    folder.list_path.unlink(missing_ok=True)
    os.mkfifo(folder.list_path)
    assert folder.allowed() == ClientList()


def test_a_list_that_changes_before_the_learner_has_begun_is_read_again(folder: KeyFolder) -> None:
    read = folder.ensure_first_client(NOW)
    default = Token.from_text(folder.token_path("default").read_text(), "").client.public
    folder.revoke("default", LATER)
    ring = Keyring(folder.server(), read, folder)
    ring.refresh()
    assert "was revoked" in ring.rejection_reason(default)


@pytest.mark.parametrize("how", ["broken", "gone", "open to others", "a folder"])
def test_a_list_that_cannot_be_read_lets_nobody_in_and_throws_nobody_out(folder: KeyFolder, how: str) -> None:
    ring = Keyring(folder.server(), folder.ensure_first_client(NOW), folder)
    lab = Token.from_text(folder.new("lab", NOW).read_text(), "").client.public
    ring.refresh()
    good = folder.list_path.read_text()
    if how == "broken":
        folder.list_path.write_text(good + "[[")
    elif how == "open to others":
        folder.list_path.chmod(0o666)
    else:
        folder.list_path.unlink()
        if how == "a folder":
            folder.list_path.mkdir()
    for _ in range(2):
        ring.refresh()
        assert "cannot be looked up" in ring.rejection_reason(lab)
        assert not ring.allowed.rejection_reason(lab)
    if how == "a folder":
        folder.list_path.rmdir()
    folder.list_path.unlink(missing_ok=True)
    folder.allow("home", HOME.public, NOW)
    ring.refresh()
    assert not ring.rejection_reason(HOME.public)
    assert ring.rejection_reason(lab)


# ---------------------------------------------------------------- where a token comes from


def test_a_token_is_a_file_or_stands_in_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "my.token"
    file.touch(mode=0o600)
    file.write_text(TEXT + "\n")
    assert read_token(str(file)) == TOKEN
    for place in (TEXT, str(file)):
        monkeypatch.setenv(TOKEN_VARIABLE, place)
        assert read_token("") == TOKEN
        assert TOKEN_VARIABLE not in os.environ, "an environment copy's children would inherit it"
    assert read_token("") is None
    monkeypatch.setenv(TOKEN_VARIABLE, TEXT[:-1])
    with pytest.raises(UsageError, match=f"{TOKEN_VARIABLE}: the join token is cut short"):
        read_token("")
    with pytest.raises(UsageError, match="cannot be read: No such file"):
        read_token(str(tmp_path / "none"))


def test_a_token_on_the_command_line_is_refused_and_not_repeated() -> None:
    with pytest.raises(UsageError, match="expected a file, got the token itself") as caught:
        read_token(TEXT)
    assert TEXT[20:40] not in str(caught.value)


def test_a_token_may_come_from_a_pipe() -> None:
    reading, writing = os.pipe()
    os.write(writing, TEXT.encode())
    os.close(writing)
    try:
        assert read_token(f"/dev/fd/{reading}") == TOKEN
    finally:
        os.close(reading)


def test_the_flag_is_stronger_than_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MILLRACE_KEYS", raising=False)
    assert chosen_key_folder("") is None
    monkeypatch.setenv("MILLRACE_KEYS", str(tmp_path))
    assert chosen_key_folder("") == tmp_path
    assert chosen_key_folder("~/k") == Path.home() / "k"


# ---------------------------------------------------------------- the lid on the log


def test_one_line_about_one_thing_in_a_while() -> None:
    lid = LogRateLimiter(every_s=60.0, most=3)
    assert lid.due("a", 0.0) == 0
    assert [lid.due("a", now) for now in (1.0, 30.0, 59.9)] == [None, None, None]
    assert lid.due("a", 60.0) == 3
    assert lid.due("b", 60.0) == 0


def test_many_things_make_few_lines_and_little_memory() -> None:
    lid = LogRateLimiter(every_s=60.0, most=3)
    said = [lid.due(str(number), number * 0.001) for number in range(10_000)]
    assert said[:3] == [0, 0, 0]
    assert set(said[3:]) == {None}
    assert len(lid._last_lines) == 3
    assert lid.due("later", 100.0) == 0
