"""Where keys live: one folder that only its owner can enter. The learner's key, the list of clients, and their tokens.

    server.key      the secret half of the learner's key, hexadecimal
    allowed.toml    the clients that may connect: public halves, names, dates
    NAME.token      the join token of a client that was made here: secret

The law: every file is made whole and 0600, under another name, and then given its own: nobody ever sees half a file or one
that others can read. A secret that others can read is not used. A list that cannot be read lets nobody in.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from protocol.errors import UsageError
from protocol.keys.keys import KEY_BYTES, ClientList, Key, Token, check_name

log = logging.getLogger("millrace.cli.keys")

DEFAULT_FOLDER = "~/.config/millrace/keys"
FOLDER_VARIABLE, TOKEN_VARIABLE = "MILLRACE_KEYS", "MILLRACE_TOKEN"
FIRST_CLIENT = "default"
OTHERS = 0o077


def chosen_key_folder(flag: str) -> Path | None:
    """The key folder that the flag, or else the environment, names; None if neither does."""
    named = flag or os.environ.get(FOLDER_VARIABLE, "")
    return Path(named).expanduser() if named else None


class KeyFolder:
    """One key folder. Made when something is written into it."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or Path(DEFAULT_FOLDER).expanduser()

    @property
    def list_path(self) -> Path:
        """The list of clients."""
        return self.path / "allowed.toml"

    def token_path(self, name: str) -> Path:
        """The token of the client of this name, if it was made here."""
        return self.path / f"{check_name(name)}.token"

    def server(self) -> Key:
        """The learner's key, made if there is none. Two learners that begin at once get the same."""
        self._open()
        path = self.path / "server.key"
        if not path.exists():
            with suppress(FileExistsError):
                _create(path, Key.new().secret.hex() + "\n")
        try:
            secret = bytes.fromhex(_read_secret(path, "key"))
        except ValueError:
            secret = b""
        if len(secret) != KEY_BYTES:
            raise UsageError(f"key {path} is damaged: expected {2 * KEY_BYTES} hexadecimal digits; restore it, or delete it")
        return Key.of_secret(secret)

    def allowed(self) -> ClientList:
        """The list of clients; empty if there is no list."""
        return self._read_list() if self.list_path.exists() else ClientList()

    def ensure_first_client(self, now: datetime) -> ClientList:
        """The list, with a first client on it if there has never been a list."""
        self._open()
        if not self.list_path.exists():
            with suppress(UsageError):  # another learner was quicker
                self.new(FIRST_CLIENT, now)
        return self._read_list()

    def new(self, name: str, now: datetime) -> Path:
        """Make a key for a client and allow it; the file of its token."""
        server, client = self.server(), Key.new()
        with self._editing():
            after = self.allowed().adding(name, client.public, now)
            _replace(self.token_path(name), Token(server.public, client).to_text() + "\n")
            _replace(self.list_path, after.to_toml())
        return self.token_path(name)

    def new_for_other_learner(self, name: str, server: bytes) -> tuple[Path, bytes]:
        """Make a key for the learner of another machine; the file of its token, and the half that must be allowed there."""
        self._open()
        client = Key.new()
        try:
            _create(self.token_path(name), Token(server, client).to_text() + "\n")
        except FileExistsError:
            raise UsageError(f"token {self.token_path(name)} is there already; take another name") from None
        return self.token_path(name), client.public

    def allow(self, name: str, public: bytes, now: datetime) -> None:
        """Allow a client that made its key itself."""
        self._open()
        with self._editing():
            _replace(self.list_path, self.allowed().adding(name, public, now).to_toml())

    def revoke(self, name: str, now: datetime) -> None:
        """Shut a client out; its token here is deleted."""
        self._open()
        with self._editing():
            _replace(self.list_path, self.allowed().revoking(name, now).to_toml())
            self.token_path(name).unlink(missing_ok=True)

    def _read_list(self) -> ClientList:
        try:
            with self.list_path.open("rb") as file:
                if stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o022:
                    raise UsageError(f"list {self.list_path} can be written by others; chmod 600 {self.list_path}")
                text = file.read().decode()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"list {self.list_path} cannot be read: {_says(error)}") from error
        return ClientList.from_toml(text, f"list {self.list_path}")

    def _open(self) -> None:
        """Make the folder if there is none. Raises `UsageError` if others can enter it."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError):
                self.path.mkdir(mode=0o700)
            mode = stat.S_IMODE(self.path.stat().st_mode)
            if not self.path.is_dir():
                raise UsageError(f"key folder {self.path}: expected a folder, got a file")
        except OSError as error:
            raise UsageError(f"key folder {self.path} cannot be made: {_says(error)}") from error
        if mode & OTHERS:
            raise UsageError(f"key folder {self.path} can be entered by others (mode {mode:04o}); chmod 700 {self.path}")

    @contextmanager
    def _editing(self) -> Iterator[None]:
        """One at a time: two commands at once must not lose each other's entry."""
        import fcntl  # not on every system; workers do without

        folder = os.open(self.path, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)
            yield
        finally:
            os.close(folder)


class Keyring:
    """The learner's key and who may connect, as it stands now. Read by two threads: what they read is replaced whole."""

    def __init__(self, key: Key, allowed: ClientList, folder: KeyFolder | None = None) -> None:
        """Without a folder the list stays as it is."""
        self.key, self.allowed, self.folder = key, allowed, folder
        self.broken = ""
        """why the list cannot be read now: nobody new comes in; who is connected stays, by the last good list"""
        self._seen = self._look()

    def refresh(self) -> None:
        """Read the list again if its file is another than it was. Never raises."""
        look = self._look()
        if self.folder is None or (look == self._seen and look):
            return
        self._seen = look
        try:
            self.allowed, broken = self.folder._read_list(), ""
        except Exception as error:
            broken = str(error)
        if broken != self.broken:
            log.log(
                logging.ERROR if broken else logging.INFO,
                "%s",
                f"{broken}; nobody new can join until it can" if broken else "the list of clients can be read again",
            )
        self.broken = broken

    def why_not_enter(self, public: bytes) -> str:
        """Why a handshake under this key fails; empty if it does not."""
        return self.allowed.why_not(public) or (f"its key cannot be looked up: {self.broken}" if self.broken else "")

    def _look(self) -> tuple[int, ...]:
        """What tells one state of the file from another; empty if there is none."""
        if self.folder is None:
            return ()
        try:
            found = self.folder.list_path.stat()
        except OSError:
            return ()
        return found.st_ino, found.st_mtime_ns, found.st_size, found.st_mode


def read_token(flag: str) -> Token | None:
    """The token that the flag's file, or else the environment, gives; None if neither does.

    The environment variable holds a file's name or the token itself, and is forgotten: what an environment copy starts must
    not inherit it. Raises `UsageError`.
    """
    given = os.environ.pop(TOKEN_VARIABLE, "").strip()
    if flag.startswith("millrace1."):
        raise UsageError(
            f"--token expected a file, got the token itself, which others can now see; put it in a file or {TOKEN_VARIABLE}"
        )
    if flag:
        return Token.from_text(_read_secret(Path(flag).expanduser(), "token"), f"token {flag}")
    if not given:
        return None
    text = (
        given
        if given.startswith("millrace") and not Path(given).exists()
        else _read_secret(Path(given).expanduser(), "token")
    )
    return Token.from_text(text, TOKEN_VARIABLE)


def _read_secret(path: Path, what: str) -> str:
    """The text of a file that nobody else can read. A pipe, as of `<(pass show millrace)`, is let pass."""
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if stat.S_ISREG(mode) and mode & OTHERS:
                raise UsageError(f"{what} {path} can be read by others (mode {stat.S_IMODE(mode):04o}); chmod 600 {path}")
            return file.read(4096).decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{what} {path} cannot be read: {_says(error)}") from error


def _says(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "it is not text"


def _create(path: Path, text: str) -> None:
    """A new file. Raises `FileExistsError` if there is one."""
    draft = _draft(path, text)
    try:
        os.link(draft, path)
    finally:
        draft.unlink()


def _replace(path: Path, text: str) -> None:
    """A file in place of whatever was there."""
    os.replace(_draft(path, text), path)


def _draft(path: Path, text: str) -> Path:
    """The whole text, 0600 from its first byte on, on the disk, under a name that nobody looks for."""
    draft = path.with_name(f".{path.name}.{os.getpid()}.{os.urandom(4).hex()}")
    try:
        descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        draft.unlink(missing_ok=True)
        raise UsageError(f"key file {path} cannot be written: {_says(error)}") from error
    return draft
