"""A request is refused unless method, Host and token are right; an answer forbids what its page does not need."""

import pytest

from millrace.extras.monitoring.dashboard.http import (
    PART_BYTES,
    PageAnswer,
    PageRequest,
    StoredBody,
    answer_parts,
    parsed,
    refusal,
    why_refused,
)

TOKEN = "the-token"
HOSTS = ("127.0.0.1:8080",)


def head(method: str = "GET", path: str = f"/{TOKEN}/", host: str | None = HOSTS[0], *more: str) -> bytes:
    lines = [f"{method} {path} HTTP/1.1", *([f"Host: {host}"] if host else []), *more]
    return "\r\n".join(lines).encode("latin-1")


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        (head(), 0),
        (head("HEAD"), 0),
        (head(path=f"/{TOKEN}"), 0),
        (head(path="/"), 404),
        (head(path="/the-toke/"), 404),
        (head(path=f"/x/{TOKEN}/"), 404),
        (head(path="/t%C3%B6k%FFen/"), 404),
        (head("POST"), 405),
        (head("get"), 405),
        (head(host="evil.example:8080"), 421),
        (head(host="127.0.0.1"), 421),
        (head(host=None), 421),
        (head("POST", path="/wrong/", host="evil.example"), 421),
        (head("GET", f"/{TOKEN}/", HOSTS[0], "Host: evil.example"), 400),
        (head(path=f"http://127.0.0.1:8080/{TOKEN}/"), 400),
        (head(path=f"/{TOKEN}/?" + "&".join(["a=1"] * 101)), 400),
        (b"", 400),
        (b"GET / HTTP/9.9", 400),
        (b"GET / HTTP/1.1\r\nno colon", 400),
        (b"\xff\xfe\x00", 400),
    ],
)
def test_who_is_refused(asked: bytes, status: int) -> None:
    assert why_refused(parsed(asked), TOKEN, HOSTS) == status


def test_any_host_is_right_where_the_server_cannot_know_its_names() -> None:
    assert why_refused(parsed(head(host="box:1")), TOKEN, ()) == 0


def test_what_a_path_and_a_query_say() -> None:
    request = parsed(head(path=f"/{TOKEN}/run/a%2Fb?metric=x%20y&run=1&run=2#no"))
    assert request is not None
    assert request.path == (TOKEN, "run", "a/b")
    assert request.query == {"metric": ["x y"], "run": ["1", "2"]}


def answer_bytes(request: PageRequest | None, answer: PageAnswer) -> bytes:
    return b"".join(answer_parts(request, answer))


def test_every_answer_forbids_what_its_page_does_not_need() -> None:
    for answer in (PageAnswer(b"page"), refusal(404)):
        text = answer_bytes(parsed(head()), answer).decode()
        for line in (
            "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;",
            "Referrer-Policy: no-referrer",
            "X-Content-Type-Options: nosniff",
            "Cache-Control: no-store",
        ):
            assert f"\r\n{line}" in text
        assert "unsafe" not in text


def test_a_page_that_has_not_changed_is_not_sent_again() -> None:
    first, _, body = answer_bytes(parsed(head()), PageAnswer(b"page")).partition(b"\r\n\r\n")
    assert body == b"page"
    tag = next(line.partition(": ")[2] for line in first.decode().split("\r\n") if line.startswith("ETag: "))
    again = head("GET", f"/{TOKEN}/", HOSTS[0], f"If-None-Match: {tag}")
    same = answer_bytes(parsed(again), PageAnswer(b"page"))
    assert same.startswith(b"HTTP/1.1 304 Not Modified\r\n")
    assert same.endswith(b"\r\n\r\n")
    assert answer_bytes(parsed(again), PageAnswer(b"another")).startswith(b"HTTP/1.1 200 OK\r\n")


def test_a_head_has_the_length_and_no_body() -> None:
    found = answer_bytes(parsed(head("HEAD")), PageAnswer(b"page"))
    assert b"Content-Length: 4\r\n" in found
    assert found.endswith(b"\r\n\r\n")


@pytest.mark.parametrize(
    ("asked", "status", "part", "place"),
    [
        ("bytes=0-", 206, b"0123456789", "0-9/10"),
        ("bytes=2-4", 206, b"234", "2-4/10"),
        ("bytes=8-100", 206, b"89", "8-9/10"),
        ("bytes=-3", 206, b"789", "7-9/10"),
        ("bytes=-100", 206, b"0123456789", "0-9/10"),
        ("bytes=10-", 416, b"", "*/10"),
        ("bytes=-0", 416, b"", "*/10"),
        ("bytes=4-2", 200, b"0123456789", ""),
        ("bytes=-", 200, b"0123456789", ""),
        ("bytes=0-1,4-5", 200, b"0123456789", ""),
        ("lines=0-1", 200, b"0123456789", ""),
        ('bytes=2-4\r\nIf-Range: "an older film"', 200, b"0123456789", ""),
    ],
)
def test_a_film_is_played_from_its_middle(asked: str, status: int, part: bytes, place: str) -> None:
    film = PageAnswer(b"0123456789", "video/mp4")
    first, _, body = answer_bytes(parsed(head("GET", f"/{TOKEN}/", HOSTS[0], f"Range: {asked}")), film).partition(
        b"\r\n\r\n"
    )
    lines = first.decode().split("\r\n")
    assert lines[0].startswith(f"HTTP/1.1 {status} ")
    assert body == part
    assert f"Content-Length: {len(part)}" in lines
    assert [line for line in lines if line.startswith("Content-Range: ")] == [f"Content-Range: bytes {place}"] * bool(place)


def test_of_a_film_no_more_is_read_than_is_wanted() -> None:
    read: list[tuple[int, int]] = []

    def part(begin: int, end: int) -> bytes:
        read.append((begin, end))
        return b"0123456789"[begin:end]

    film = PageAnswer(StoredBody("tag", 10, part), "video/mp4")
    asked = {"Range: bytes=2-4": [(2, 5)], 'If-None-Match: "tag"': [(0, 0)], "Accept: video/mp4": [(0, 10)]}
    for line, wanted in asked.items():
        read.clear()
        answer = answer_bytes(parsed(head("GET", f"/{TOKEN}/", HOSTS[0], line)), film)
        assert read == wanted
        assert answer.partition(b"\r\n\r\n")[2] == b"".join(b"0123456789"[begin:end] for begin, end in wanted)
    parts = answer_parts(parsed(head()), PageAnswer(StoredBody("tag", 3 * PART_BYTES, part)))
    read.clear()
    next(parts)
    assert read == [(0, PART_BYTES)], "the next is read when this one is sent"
    assert [*parts, *read[1:]] == [b"", b"", (PART_BYTES, 2 * PART_BYTES), (2 * PART_BYTES, 3 * PART_BYTES)]
