"""The link to the centre: enrolment, tokens, problems, bandwidth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engram.errors import EngramError, InputError, extra, storage_full
from engram.fleet.agent.agent_state import AgentState
from engram.fleet.transfers import PartHash, Signer, Unbundler, bundle, enrolment_text, token_text
from engram.monitor import write_whole

if TYPE_CHECKING:
    import httpx


BUNDLE = "application/vnd.engram.bundle"


class CentreRefusedError(EngramError):
    """The centre answered with a problem.

    Attributes:
        status: HTTP's.
    """

    def __init__(self, status: int, detail: str) -> None:
        super().__init__(f"the centre refuses ({status}): {detail}")
        self.status = status


class Unreachable(EngramError):  # noqa: N818 - a state of the link, not a fault
    """The centre cannot be reached now, or broke off."""


def new_client(url: str, **options: Any) -> httpx.Client:
    """A client of a centre.

    Raises:
        MissingExtraError: httpx is not installed.
    """
    with extra("agent", "the agent needs httpx"):
        import httpx
    return httpx.Client(base_url=url, timeout=30.0, **options)


class CentreLink:
    """Requests of one robot.

    Args:
        client: of the centre.
        robot: the robot's id.
        signer: its key.
        bytes_per_s: cap of both directions; None for none.
        wait: waits some seconds.
    """

    def __init__(
        self,
        client: httpx.Client,
        robot: str,
        signer: Signer,
        bytes_per_s: float | None,
        wait: Callable[[float], object],
    ) -> None:
        self._client = client
        self._robot = robot
        self._signer = signer
        self._bytes_per_s = bytes_per_s
        self._wait = wait
        self._token = ""
        self.sent_bytes = 0
        self.received_bytes = 0

    def close(self) -> None:
        """Closes the client's connections."""
        self._client.close()

    def ask(
        self,
        method: str,
        path: str,
        body: Any = None,
        parts: Callable[[], Iterator[bytes]] | None = None,
    ) -> Any:
        """One request with JSON out, and JSON or a bundle of parts in.

        Parts that arrived stay at the centre, whatever happens then.

        Raises:
            CentreRefusedError: the centre answers with a problem.
            Unreachable: there is no answer.
        """
        import httpx

        for _ in ("with the token so far", "with a new one"):
            headers, options = self._headers(), dict[str, Any]()
            if parts is not None:
                headers["Content-Type"] = BUNDLE
                options["content"] = self._paced(bundle(parts()))
            elif body is not None:
                options["json"] = body
            try:
                answer = self._client.request(method, path, headers=headers, **options)
            except httpx.HTTPError as error:
                raise _out_of_reach(error) from error
            self.received_bytes += len(answer.content)
            self.sent_bytes += int(answer.request.headers.get("content-length", 0))
            if answer.status_code != 401:
                break
            self._token = ""
        _check(answer)
        return _content(answer) if answer.content else None

    def receive(self, path: str, wanted: list[PartHash]) -> Iterator[tuple[PartHash, bytes]]:
        """Parts of a bundle as they arrive, verified.

        Raises:
            CentreRefusedError: the centre answers with a problem.
            Unreachable: the link broke; what was yielded is whole.
        """
        import httpx

        body = {"want": [part.hex() for part in wanted]}
        opened = Unbundler()
        try:
            with self._client.stream("POST", path, json=body, headers=self._headers()) as answer:
                if answer.status_code >= 400:
                    answer.read()
                    _check(answer)
                for piece in answer.iter_bytes():  # in pieces of a size, a cut loses one
                    self.received_bytes += len(piece)
                    yield from opened.feed(piece)
                    self._pace(len(piece))
        except httpx.HTTPError as error:
            raise Unreachable(f"the connection broke: {error!r}") from error

    def _headers(self) -> dict[str, str]:
        """Headers with a token, requested if missing by signing the centre's nonce."""
        if not self._token:
            body = {"robot": self._robot}
            nonce = _post(self._client, "/v1/token/nonce", body)["nonce"]
            signature = self._signer.sign(token_text(self._robot, nonce)).hex()
            body |= {"nonce": nonce, "signature": signature}
            self._token = _post(self._client, "/v1/token", body)["token"]
        return {"Authorization": f"Bearer {self._token}"}

    def _paced(self, pieces: Iterator[bytes]) -> Iterator[bytes]:
        for piece in pieces:
            yield piece
            self.sent_bytes += len(piece)
            self._pace(len(piece))

    def _pace(self, size: int) -> None:
        if self._bytes_per_s is not None:
            self._wait(size / self._bytes_per_s)


def _post(client: httpx.Client, path: str, body: Any) -> Any:
    """One request without a token."""
    import httpx

    try:
        answer = client.post(path, json=body)
    except httpx.HTTPError as error:
        raise _out_of_reach(error) from error
    _check(answer)
    return _content(answer)


def _check(answer: httpx.Response) -> None:
    """Raises what an answer with a problem stands for."""
    status = answer.status_code
    if status < 400:
        return
    try:
        detail = str(answer.json().get("detail", ""))
    except (ValueError, AttributeError):
        detail = answer.text[:200]
    if status in {502, 503, 504}:
        raise Unreachable(f"the centre is unavailable now (status {status}): {detail}")
    raise CentreRefusedError(status, detail)


def _out_of_reach(error: Exception) -> Unreachable:
    fact = f"the centre cannot be reached: {error!r}"
    if "CERTIFICATE_VERIFY_FAILED" in fact:
        fact += "; SSL_CERT_FILE can name the certificate of a centre that signs for itself"
    return Unreachable(fact)


def _content(answer: httpx.Response) -> Any:
    """The JSON of an answer.

    Raises:
        Unreachable: something else answers, as the login page of a network does.
    """
    try:
        return answer.json()
    except ValueError as error:
        raise Unreachable(
            f"no centre answers at {answer.url} (status {answer.status_code}, not JSON); check "
            "the address and any proxy"
        ) from error


FOLDERS = ("live", "base", "next")


def enrol(folder: Path, url: str, code: str, name: str, client: httpx.Client | None = None) -> str:
    """Enrols a robot with a centre; the key pair is made here and never leaves the folder.

    Returns:
        The name of its map.

    Raises:
        InputError: the folder has an agent of another centre already, or cannot hold one.
        CentreRefusedError: the code is not valid.
        Unreachable: the centre does not answer.
    """
    url = url.rstrip("/")
    _check_centre(folder, url)
    key = folder / "key"
    try:
        for kept in FOLDERS:
            (folder / kept).mkdir(parents=True, exist_ok=True)
        if not key.exists():
            with write_whole(key) as draft:
                draft.touch(mode=0o600)
                draft.write_bytes(Signer.new_key())
    except OSError as error:
        fact = f"{folder} cannot hold an agent: {error.strerror}"
        raise storage_full(error, folder) or InputError(fact) from error
    signer = signer_of(key)
    body = {
        "code": code,
        "name": name,
        "public_key": signer.public_key.hex(),
        "signature": signer.sign(enrolment_text(code)).hex(),
    }
    answer = _post(client or new_client(url), "/v1/robots/enrol", body)
    state = AgentState(folder / "agent.sqlite")
    state.remember(url=url, robot=answer["robot"], map=answer["maps"][0], name=name)
    state.close()
    return str(answer["maps"][0])


def signer_of(key: Path) -> Signer:
    """A signer with a robot's key.

    Raises:
        InputError: it is missing, or not one.
    """
    try:
        return Signer(key.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(
            f"{key} is not a robot's key ({error}); remove it and enrol the robot again"
        ) from error


def enrolled(folder: Path) -> AgentState:
    """Opens the state of an agent.

    Raises:
        InputError: the robot is not enrolled, or only half.
    """
    path = folder / "agent.sqlite"
    if path.exists():
        state = AgentState(path)
        if state.facts.robot is not None:
            return state
        state.close()
    raise InputError(
        f"{folder} is not the folder of an enrolled robot; enrol it: engram agent enrol {folder} "
        "URL CODE --robot NAME"
    )


def _check_centre(folder: Path, url: str) -> None:
    """Checks that a folder holds no agent of another centre, whose state would remain."""
    path = folder / "agent.sqlite"
    if not path.exists():
        return
    state = AgentState(path)
    known = state.facts
    state.close()
    if known.url is not None and known.url.rstrip("/") != url:
        raise InputError(
            f"{folder} belongs to the robot {known.name!r} of {known.url}; give another folder for "
            f"{url}"
        )
