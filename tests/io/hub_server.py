"""A stand-in for a hub of models on this machine: what huggingface_hub asks a server for."""

import base64
import contextlib
import dataclasses
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclasses.dataclass
class Hub:
    """Models by name: commits, and the files of each; faults to make.

    ``cut`` is the number of bytes after which the download of a large file breaks off, each time
    it is asked for; 0 for none. ``wrong`` sends large files with a byte changed.
    """

    models: dict = dataclasses.field(default_factory=dict)
    cut: int = 0
    wrong: bool = False
    requests: list = dataclasses.field(default_factory=list)
    address: str = ""

    def add(self, name, files):
        """Add a commit of files, bytes by path; return its hash."""
        commits = self.models.setdefault(name, {})
        commit = hashlib.sha1(repr((name, len(commits), sorted(files))).encode()).hexdigest()
        commits[commit] = dict(files)
        return commit

    def add_folder(self, name, folder):
        files = (path for path in sorted(folder.rglob("*")) if path.is_file())
        return self.add(name, {str(p.relative_to(folder)): p.read_bytes() for p in files})

    def commit(self, name, revision):
        commits = self.models.get(name)
        if commits is None:
            return None
        return list(commits)[-1] if revision == "main" else revision if revision in commits else ""


def is_large(content):
    return len(content) > 1000


def sha256(content):
    return hashlib.sha256(content).hexdigest()


def git(content):
    return hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()


@contextlib.contextmanager
def serving():  # noqa: C901
    """Serve a hub until the block ends."""
    hub = Hub()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_):
            pass

        def reply(self, value, status=200, **headers):
            body = value if isinstance(value, bytes) else json.dumps(value).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            for name, text in headers.items():
                self.send_header(name.replace("_", "-"), text)
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        def lacking(self, code):
            self.reply({"error": code}, 404, X_Error_Code=code)

        def body(self):
            if self.headers.get("Transfer-Encoding") == "chunked":
                parts = []
                while size := int(self.rfile.readline(), 16):
                    parts.append(self.rfile.read(size))
                    self.rfile.readline()
                self.rfile.readline()
                return b"".join(parts)
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))

        def do_HEAD(self):
            self.do_GET()

        def do_GET(self):
            path = self.path.split("?")[0]
            hub.requests.append((self.command, path))
            if found := re.fullmatch(r"/api/models/(.+?/.+?)/(revision|tree)/([^/]+).*", path):
                self.describe(*found.groups())
            elif found := re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
                self.file(*found.groups())
            else:
                self.lacking("RepoNotFound")

        def describe(self, name, what, revision):
            commit = hub.commit(name, revision)
            if not commit:
                self.lacking("RepoNotFound" if commit is None else "RevisionNotFound")
                return
            files = hub.models[name][commit]
            if what == "revision":
                siblings = [{"rfilename": path} for path in files]
                self.reply({"id": name, "modelId": name, "sha": commit, "siblings": siblings})
                return
            entries = []
            for path, content in files.items():
                entry = {"type": "file", "path": path, "size": len(content), "oid": git(content)}
                if is_large(content):
                    entry["lfs"] = {
                        "oid": sha256(content),
                        "size": len(content),
                        "pointerSize": 130,
                    }
                entries.append(entry)
            self.reply(entries)

        def file(self, name, revision, path):
            commit = hub.commit(name, revision)
            content = hub.models.get(name, {}).get(commit, {}).get(path)
            if content is None:
                self.lacking("EntryNotFound")
                return
            tag = sha256(content) if is_large(content) else git(content)
            start = 0
            if found := re.match(r"bytes=(\d+)-", self.headers.get("Range", "")):
                start = int(found[1])
            rest = content[start:]
            self.send_response(206 if start else 200)
            self.send_header("ETag", f'"{tag}"')
            self.send_header("X-Repo-Commit", commit)
            self.send_header("Content-Length", str(len(rest)))
            if start:
                self.send_header(
                    "Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}"
                )
            self.end_headers()
            if self.command == "HEAD":
                return
            if is_large(content) and hub.wrong:
                rest = rest[:-1] + bytes([rest[-1] ^ 1])
            if is_large(content) and hub.cut:
                self.wfile.write(rest[: hub.cut])
                self.close_connection = True
                return
            self.wfile.write(rest)

        def do_POST(self):
            path = self.path.split("?")[0]
            hub.requests.append((self.command, path))
            body = self.body()
            if path == "/api/repos/create":
                asked = json.loads(body)
                name = f"{asked['organization']}/{asked['name']}"
                exists = name in hub.models
                hub.models.setdefault(name, {})
                self.reply({"url": f"{hub.address}/{name}"}, 409 if exists else 200)
            elif found := re.fullmatch(r"/api/models/(.+?/.+?)/preupload/.*", path):
                files = json.loads(body)["files"]
                modes = [
                    {"path": f["path"], "uploadMode": "regular", "shouldIgnore": False}
                    for f in files
                ]
                self.reply({"files": modes})
            elif found := re.fullmatch(r"/api/models/(.+?/.+?)/commit/.*", path):
                lines = [json.loads(line) for line in body.splitlines() if line]
                files = {
                    line["value"]["path"]: base64.b64decode(line["value"]["content"])
                    for line in lines
                    if line["key"] == "file"
                }
                commit = hub.add(found[1], files)
                url = f"{hub.address}/{found[1]}/commit/{commit}"
                self.reply({"success": True, "commitOid": commit, "commitUrl": url})
            else:
                self.reply({})

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    hub.address = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
