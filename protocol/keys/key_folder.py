"""The key folder, which only its owner can enter: the learner's key, the list of clients, and their tokens.

    server.key      the secret half of the learner's key, in hexadecimal
    allowed.toml    the clients that may connect: the public halves of their keys, their names, and dates
    NAME.token      the join token of a client whose key was made here; it is secret

Rule: a file is written completely, with mode 0600, under a temporary name and then renamed, so no reader sees a partial
file or one that others can read. A secret that others can read is not used. If the list cannot be read, no new client can
connect.
"""

from __future__ import annotations

import fcntl
import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from millrace.protocol.errors import UsageError
from millrace.protocol.home_folder import expanded
from millrace.protocol.keys.keys import KEY_BYTES, ClientList, Key, Token, check_name

log = logging.getLogger("millrace.cli.keys")

DEFAULT_FOLDER = "~/.config/millrace/keys"
FOLDER_VARIABLE = "MILLRACE_KEYS"
FIRST_CLIENT = "default"
OTHERS_MODE = 0o077  # permission bits of group and others


def chosen_key_folder(flag: str) -> Path | None:
    """The key folder that the flag names, or else the environment variable; None if neither is set."""
    named = flag or os.environ.get(FOLDER_VARIABLE, "")
    return expanded(named, "key folder") if named else None


class KeyFolder:
    """A key folder. It is created when something is first written into it."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or expanded(DEFAULT_FOLDER, "key folder")

    @property
    def list_path(self) -> Path:
        """Path of the list of clients."""
        return self.path / "allowed.toml"

    def token_path(self, name: str) -> Path:
        """Path of the token of the client with this name."""
        return self.path / f"{check_name(name)}.token"

    def first_token(self, allowed: ClientList) -> Path | None:
        """The path of the first token in this folder that belongs to one of these clients; None if there is none."""
        return next((path for path in map(self.token_path, allowed.names()) if path.is_file()), None)

    def server(self) -> Key:
        """The learner's key, created if there is none. Learners that start at the same time get the same key."""
        self._ensure_folder()
        path = self.path / "server.key"
        if not path.exists():
            with suppress(FileExistsError):
                _create(path, Key.new().secret.hex() + "\n")
        try:
            secret = bytes.fromhex(read_secret(path, "key"))
        except ValueError:
            secret = b""
        if len(secret) != KEY_BYTES:
            raise UsageError(f"key {path} is damaged: expected {2 * KEY_BYTES} hexadecimal digits; restore it, or delete it")
        return Key.from_secret(secret)

    def allowed(self) -> ClientList:
        """The list of clients; empty if there is no list."""
        return self._read_list() if self.list_path.is_file() else ClientList()

    def ensure_first_client(self, now: datetime) -> ClientList:
        """The list of clients. If there is none, it is created with a first client."""
        self._ensure_folder()
        if not self.list_path.exists():
            with suppress(UsageError):  # another learner created it first
                self.new(FIRST_CLIENT, now)
        return self._read_list()

    def new(self, name: str, now: datetime) -> Path:
        """Create a key for a client, and allow it to connect. Returns the path of the client's token."""
        server = self.server()
        client = Key.new()
        with self._locked():
            after = self.allowed().with_client(name, client.public, now)
            _replace(self.token_path(name), Token(server.public, client).to_text() + "\n")
            _replace(self.list_path, after.to_toml())
        return self.token_path(name)

    def new_for_other_learner(self, name: str, server: bytes) -> tuple[Path, bytes]:
        """Create a client's key for a learner on another machine. `server` is the learner's public key.

        Returns the path of the client's token, and the public half of the client's key.
        """
        self._ensure_folder()
        client = Key.new()
        try:
            _create(self.token_path(name), Token(server, client).to_text() + "\n")
        except FileExistsError:
            raise UsageError(f"token {self.token_path(name)} is there already; take another name") from None
        return self.token_path(name), client.public

    def allow(self, name: str, public: bytes, now: datetime) -> None:
        """Allow a client that created its own key to connect. `public` is the public half of that key."""
        self._ensure_folder()
        with self._locked():
            _replace(self.list_path, self.allowed().with_client(name, public, now).to_toml())

    def revoke(self, name: str, now: datetime) -> None:
        """Revoke a client, and delete its token from this folder."""
        self._ensure_folder()
        with self._locked():
            _replace(self.list_path, self.allowed().with_revoked(name, now).to_toml())
            self.token_path(name).unlink(missing_ok=True)

    def _read_list(self) -> ClientList:
        try:
            with self.list_path.open("rb") as file:
                if stat.S_IMODE(os.fstat(file.fileno()).st_mode) & 0o022:
                    raise UsageError(f"list {self.list_path} can be written by others; chmod 600 {self.list_path}")
                text = file.read().decode()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"list {self.list_path} cannot be read: {_error_text(error)}") from error
        return ClientList.from_toml(text, f"list {self.list_path}")

    def _ensure_folder(self) -> None:
        """Create the folder if there is none. Raises `UsageError` if it can't be created, or others can enter it."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError):
                self.path.mkdir(mode=0o700)
            mode = stat.S_IMODE(self.path.stat().st_mode)
            if not self.path.is_dir():
                raise UsageError(f"key folder {self.path}: expected a folder, got a file")
        except OSError as error:
            raise UsageError(f"key folder {self.path} cannot be made: {_error_text(error)}") from error
        if mode & OTHERS_MODE:
            raise UsageError(f"key folder {self.path} can be entered by others (mode {mode:04o}); chmod 700 {self.path}")

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the folder's lock, so that two commands running at the same time don't overwrite each other's entries."""
        folder = os.open(self.path, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)
            yield
        finally:
            os.close(folder)


class Keyring:
    """The learner's key and the current list of clients. Two threads read it; `refresh` replaces the list as one object."""

    def __init__(self, key: Key, allowed: ClientList, folder: KeyFolder | None = None) -> None:
        """`folder`: when the list in it changes, it is read again. If `folder` is None, the list never changes."""
        self.key = key
        self.allowed = allowed
        self.folder = folder
        self.read_error = ""
        """Why the list cannot be read now; empty if it can. While it can't, no client can join, but connected ones stay."""
        self._read_state: tuple[int, ...] = ()  # `_file_state` when the list was last read

    def refresh(self) -> None:
        """Read the list again if its file has changed. Never raises."""
        state = self._file_state()
        if self.folder is None or (state == self._read_state and state):
            return
        self._read_state = state
        try:
            self.allowed = self.folder._read_list()
            error_text = ""
        except Exception as error:
            error_text = str(error)
        if error_text != self.read_error:
            log.log(
                logging.ERROR if error_text else logging.INFO,
                "%s",
                f"{error_text}; nobody new can join until it can" if error_text else "the list of clients can be read again",
            )
        self.read_error = error_text

    def rejection_reason(self, public: bytes) -> str:
        """Why a handshake with this public key is refused, or an empty string if it is accepted."""
        return self.allowed.rejection_reason(public) or (
            f"its key cannot be looked up: {self.read_error}" if self.read_error else ""
        )

    def _file_state(self) -> tuple[int, ...]:
        """Inode, modification time, size and mode of the list; empty if there is no file."""
        if self.folder is None:
            return ()
        try:
            found = self.folder.list_path.stat()
        except OSError:
            return ()
        return found.st_ino, found.st_mtime_ns, found.st_size, found.st_mode


def read_secret(path: Path, what: str) -> str:
    """The text of a file that only its owner can read. A pipe, such as `<(pass show millrace)`, is accepted too.

    Raises `UsageError`, in which `what` names the file, if others can read it or it can't be read.
    """
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if stat.S_ISREG(mode) and mode & OTHERS_MODE:
                raise UsageError(f"{what} {path} can be read by others (mode {stat.S_IMODE(mode):04o}); chmod 600 {path}")
            return file.read(4096).decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{what} {path} cannot be read: {_error_text(error)}") from error


def _error_text(error: Exception) -> str:
    return error.strerror or str(error) if isinstance(error, OSError) else "it is not text"


def _create(path: Path, text: str) -> None:
    """Create a file. Raises `FileExistsError` if it exists, and `UsageError` if it cannot be written."""
    temporary = _write_temporary(path, text)
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise
    except OSError as error:  # some file systems have no hard links
        raise UsageError(f"key file {path} cannot be written: {_error_text(error)}") from error
    finally:
        temporary.unlink()


def _replace(path: Path, text: str) -> None:
    """Create a file, or replace it. Raises `UsageError` if it cannot be written. No temporary file is left behind."""
    temporary = _write_temporary(path, text)
    try:
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink()
        raise UsageError(f"key file {path} cannot be written: {_error_text(error)}") from error


def _write_temporary(path: Path, text: str) -> Path:
    """Write the text to disk under a temporary name, with mode 0600 from the start. Returns the path of that file."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{os.urandom(4).hex()}")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UsageError(f"key file {path} cannot be written: {_error_text(error)}") from error
    return temporary
