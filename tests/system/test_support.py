"""The archive for the report of a fault has the facts that explain a fault, and no byte of a secret."""

import gzip
import io
import json
import os
import tarfile
from base64 import b64encode, urlsafe_b64encode
from urllib.parse import quote

import pytest

from forked_process import run_process
from optodrive.cli.main import run
from optodrive.cli.support_archive import REMOVED, Redaction
from rig import OPTODRIVE, TOKEN

HEAD = 'format = "optodrive-tokens"\nversion = 1\n'
ENTRY = '[[token]]\nname = "{}"\nrole = "{}"\nsecret = {}\n'
SECRETS = {
    "rig": TOKEN,
    "ben": 'quotes-"and\\back-slashes+/=',
    "cara": "planted-secret-of-cara-0123456789",
    "environment": "only-in-the-environment-9876",
}
UNKNOWN = "hunter2hunter2-of-a-revoked-token"
"""Known to no file: removed where it is named as a secret."""


def list_forms(secret):
    data = secret.encode()
    encoded = [b64encode(data).decode(), urlsafe_b64encode(data).decode()]
    return [secret, json.dumps(secret)[1:-1], quote(secret, safe=""), *(text.rstrip("=") for text in encoded)]


def plant(path):
    """Write a log that shows every secret in every form, beside the facts that a report needs."""
    lines = [f"fact of {path.name} {form} end" for secret in SECRETS.values() for form in list_forms(secret)]
    lines += [
        f"Authorization: Bearer {UNKNOWN}",
        f"authorization: basic {UNKNOWN}",
        f"Cookie: optodrive-8450={UNKNOWN}; a=b",
        f"GET /#token={UNKNOWN} HTTP/1.1",
        f'{{"secret": "{UNKNOWN}", "pixel": 5}}',
        f"OPTODRIVE_TOKEN={UNKNOWN}",
        f"Sec-WebSocket-Protocol: optodrive, bearer.{UNKNOWN}",
        f"password = '{UNKNOWN}'",
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def report(board, make_daemon, tmp_path):
    """Return the packed archive of a running daemon, its bytes unpacked, and its entries by name."""
    kept, audit = tmp_path / "kept.toml", tmp_path / "audit.jsonl"
    kept.write_text(
        HEAD + "".join(ENTRY.format(name, "armer", json.dumps(SECRETS[name])) for name in ("rig", "ben", "cara"))
    )
    kept.chmod(0o600)
    section = f'[daemon]\ntokens = "{kept}"\naudit = "{plant(audit)}"\n# for tests: {SECRETS["cara"]}\n#'
    daemon = make_daemon(board, replace=[("lease_s = 1.0", f"lease_s = 1.0\n{section}")])
    daemon.call("POST", "/v1/disarm")
    environment = {**os.environ, "OPTODRIVE_TOKEN": SECRETS["rig"], "OPTODRIVE_NOTE": SECRETS["environment"]}
    environment["OPTODRIVE_OLD_TOKEN"] = UNKNOWN
    out = tmp_path / "report.tar.gz"
    options = ["--url", daemon.url, "--config", daemon.config, "--log", plant(tmp_path / "daemon.log"), "--out", out]
    done = run_process([OPTODRIVE, "support", *map(str, options)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert "read it before you send it" in done.stdout
    assert out.stat().st_mode & 0o777 == 0o600
    packed = out.read_bytes()
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        entries = {item.name: archive.extractfile(item).read().decode() for item in archive}
    return packed + gzip.decompress(packed), entries


def test_the_archive_has_the_facts_and_no_secret(report):
    content, entries = report
    planted = [form for name, secret in SECRETS.items() if name != "environment" for form in list_forms(secret)]
    for form in [*planted, UNKNOWN]:
        assert form.encode() not in content, form
    files = {name.removeprefix("optodrive-support/"): text for name, text in entries.items()}
    assert "optodrive " in files["versions.txt"]
    assert "rows = " in files["configuration/config.toml"]
    assert "configuration valid" in files["configuration/check.txt"]
    assert json.loads(files["daemon/state.json"])["board"]["state"] == "DISARMED"
    assert files["logs/audit.jsonl"].count("fact of audit.jsonl") == 5 * len(SECRETS)
    assert '"POST /v1/disarm"' in files["logs/audit.jsonl"]
    assert files["logs/0-daemon.log"].count("fact of daemon.log") == 5 * len(SECRETS)
    assert f"OPTODRIVE_TOKEN={REMOVED}" in files["environment.txt"]
    assert '"pixel": 5' in files["logs/0-daemon.log"]


def test_without_a_daemon_and_with_a_damaged_configuration_there_is_an_archive(tmp_path, capsys):
    config = tmp_path / "config.toml"
    config.write_text("rows = 4 4\n")
    out = tmp_path / "report.tar.gz"
    arguments = ["support", "--config", str(config), "--url", "http://127.0.0.1:9", "--out", str(out)]
    assert run([*arguments, "--log", "/dev/zero"]) == 0
    with tarfile.open(out) as archive:
        texts = {item.name.partition("/")[2]: archive.extractfile(item).read().decode() for item in archive}
    assert "line 1, column 10" in texts["configuration/check.txt"]
    assert "rows = 4 4" in texts["configuration/config.toml"]
    assert texts["daemon/state.json"].startswith("not available: ")
    assert "a device" in texts["logs/0-zero"]
    assert run(arguments) == 2
    assert "expected a new file; this one exists" in capsys.readouterr().err


def test_text_without_secrets_stays_as_it_is():
    text = 'tokens = "/var/lib/optodrive/tokens.toml"\nthe token of anna was revoked\nkey = true\n{"role": "armer"}\n'
    assert Redaction(["a-known-secret-of-anna"]).redact(text) == text
