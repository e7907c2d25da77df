"""A small server with those endpoints of the Hugging Face hub that ``huggingface_hub`` calls here.

Its answers follow the client's code (2.4.0), and large files go the way of its HTTP uploads. Xet, the storage protocol that
``huggingface_hub`` prefers for them where the hub offers it, is not here.
"""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

TOKEN = "hf_test"
COMMIT = "0123456789abcdef0123456789abcdef01234567"


class FakeHub(ThreadingHTTPServer):
    """:ivar repositories: name to its files, each name to content"""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repositories: dict[str, dict[str, bytes]] = {}
        self.private: set[str] = set()
        self.messages: list[str] = []
        #: contents of large files, by SHA-256
        self.large: dict[str, bytes] = {}
        #: what is said instead of a file's size
        self.said_sizes: dict[str, int] = {}
        #: names in answers beyond those that were asked for
        self.more_names: list[str] = []
        #: ``(method, path)`` of every request
        self.requests: list[tuple[str, str]] = []
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: FakeHub

    def log_message(self, *_: Any) -> None:
        pass

    def do_GET(self) -> None:
        self._begin()
        if self.path.startswith("/large/"):
            return self._answer(self.server.large[self.path.removeprefix("/large/")])
        if self.path.startswith("/api/models/"):
            name, _, revision = self.path.removeprefix("/api/models/").partition("/revision/")
            if self._files(name, revision or "main") is not None:
                private = name in self.server.private
                self._json({"id": name, "modelId": name, "sha": COMMIT, "private": private})
            return None
        name, _, place = self.path.removeprefix("/").partition("/resolve/")
        revision, _, file = place.partition("/")
        files = self._files(name, revision)
        if files is None:
            return None
        if file not in files:
            return self._refuse(404, "EntryNotFound", "Entry not found")
        if file.endswith(".npz"):
            return self._redirect(f"/large/{self._keep(files[file])}")
        return self._answer(files[file])

    def do_POST(self) -> None:
        body = self._begin()
        if self.headers.get("Authorization") != f"Bearer {TOKEN}" and not self.path.rpartition("/")[0].endswith("/paths-info"):
            return self._refuse(401, None, "Invalid username or password.")
        if self.path == "/api/validate-yaml":
            return self._json({"errors": [], "warnings": []})
        if self.path == "/api/repos/create":
            return self._create(json.loads(body))
        if self.path.endswith(".git/info/lfs/objects/batch"):
            objects = [
                {"oid": item["oid"], "size": item["size"],
                 "actions": {"upload": {"href": f"{self.server.url}/large/{item['oid']}", "header": {}}}}
                for item in json.loads(body)["objects"]
            ]  # fmt: skip
            return self._json({"transfer": "basic", "objects": objects})
        name, verb, revision = self.path.removeprefix("/api/models/").rsplit("/", 2)
        files = self._files(name, revision)
        if files is None:
            return None
        if verb == "paths-info":
            asked = parse_qs(body.decode())["paths"]
            found = [path for path in files if path in asked] + self.server.more_names
            return self._json([self._described(path, files.get(path, b"")) for path in found])
        if verb == "preupload":
            modes = [
                {
                    "path": file["path"],
                    "uploadMode": "lfs" if file["path"].endswith(".npz") else "regular",
                    "shouldIgnore": False,
                }
                for file in json.loads(body)["files"]
            ]
            return self._json({"files": modes})
        return self._commit(name, files, [json.loads(line) for line in body.splitlines()])

    def do_PUT(self) -> None:
        body = self._begin()
        digest = hashlib.sha256(body).hexdigest()
        assert self.path == f"/large/{digest}"
        self.server.large[digest] = body
        self._answer(b"")

    def _begin(self) -> bytes:
        self.path = unquote(urlsplit(self.path).path)
        self.server.requests.append((self.command, self.path))
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def _files(self, name: str, revision: str) -> dict[str, bytes] | None:
        """A repository's; where it is none, or is another's, the answer is given already."""
        hidden = name in self.server.private and self.headers.get("Authorization") != f"Bearer {TOKEN}"
        if hidden or name not in self.server.repositories:
            return self._refuse(404, "RepoNotFound", "Repository not found")
        if revision not in ("main", COMMIT):
            return self._refuse(404, "RevisionNotFound", f"Invalid rev id: {revision}")
        return self.server.repositories[name]

    def _create(self, asked: dict[str, Any]) -> None:
        name = f"{asked['organization']}/{asked['name']}"
        if asked["organization"] != "me":
            return self._refuse(403, None, "You don't have the rights to create a model under this namespace")
        url = {"url": f"{self.server.url}/{name}"}
        if name in self.server.repositories:
            return self._json(url, 409)
        self.server.repositories[name] = {}
        if asked.get("visibility") == "private" or asked.get("private"):
            self.server.private.add(name)
        return self._json(url)

    def _commit(self, name: str, files: dict[str, bytes], lines: list[dict[str, Any]]) -> None:
        for line in lines:
            value = line["value"]
            if line["key"] == "header":
                self.server.messages.append(value["summary"])
            elif line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.server.large[value["oid"]]
            else:
                assert line["key"] == "deletedFile"
                del files[value["path"]]
        self._json({"commitUrl": f"{self.server.url}/{name}/commit/{COMMIT}", "commitOid": COMMIT})

    def _described(self, path: str, content: bytes) -> dict[str, Any]:
        size = self.server.said_sizes.get(path, len(content))
        return {"type": "file", "path": path, "size": size, "oid": hashlib.sha1(content).hexdigest()}

    def _keep(self, content: bytes) -> str:
        digest = hashlib.sha256(content).hexdigest()
        self.server.large[digest] = content
        return digest

    def _json(self, content: Any, status: int = 200) -> None:
        self._answer(json.dumps(content).encode(), status, {"Content-Type": "application/json"})

    def _refuse(self, status: int, code: str | None, message: str) -> None:
        headers = {"X-Error-Message": message, **({"X-Error-Code": code} if code else {})}
        self._answer(json.dumps({"error": message}).encode(), status, {"Content-Type": "application/json", **headers})

    def _redirect(self, to: str) -> None:
        self._answer(b"", 302, {"Location": f"{self.server.url}{to}"})

    def _answer(self, content: bytes, status: int = 200, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(content)), "X-Repo-Commit": COMMIT, **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)
