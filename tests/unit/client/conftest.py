import subprocess

import pytest


@pytest.fixture
def certificate(tmp_path):
    """Return the files of a certificate of localhost, which nobody trusts, and of its key."""
    path, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    names = ("-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost")
    options = ("-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *names, "-keyout", key)
    subprocess.run(["openssl", "req", *options, "-out", path], check=True, capture_output=True)
    return path, key
