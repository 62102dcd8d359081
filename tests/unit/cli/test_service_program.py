"""Programs for the unit: one that its sandbox hides is refused, also behind links and virtual environments."""

import subprocess
import sys
from pathlib import Path

import pytest

from optodrive.cli import service_program
from optodrive.cli.service_program import check_program
from optodrive.core.errors import RefusedError

REAL_PYTHON = Path(sys.executable).resolve()


@pytest.fixture
def hidden(tmp_path, monkeypatch):
    """Return a folder that counts as the only hidden one."""
    folder = tmp_path / "root"
    folder.mkdir()
    monkeypatch.setattr(service_program, "HIDDEN_FOLDERS", (str(folder),))
    return folder


@pytest.fixture
def visible(tmp_path):
    folder = tmp_path / "opt"
    folder.mkdir()
    return folder


def make_environment(folder, base):
    """Create a virtual environment on a base interpreter. Return its script `optodrive`."""
    subprocess.run([base, "-m", "venv", "--without-pip", folder], check=True)
    script = folder / "bin" / "optodrive"
    script.write_text(f"#!{folder}/bin/python\nimport optodrive.cli.main\n")
    script.chmod(0o755)
    return script


def assert_refused(program, *naming):
    with pytest.raises(RefusedError) as caught:
        check_program(program)
    text = str(caught.value)
    assert all(str(part) in text for part in ("--program", *naming)), text
    assert "\n" not in text


def test_a_visible_environment_is_accepted(hidden, visible):
    check_program(make_environment(visible / "venv", REAL_PYTHON))


def test_a_link_into_a_hidden_folder_is_refused(hidden, visible):
    script = make_environment(hidden / "venv", REAL_PYTHON)
    link = visible / "optodrive"
    link.symlink_to(script)
    assert_refused(link, hidden, script)


def test_an_environment_in_a_linked_folder_is_refused(hidden, visible):
    make_environment(hidden / "venv", REAL_PYTHON)
    (visible / "venv").symlink_to(hidden / "venv")
    assert_refused(visible / "venv" / "bin" / "optodrive", hidden)


def test_an_environment_on_a_hidden_interpreter_is_refused(hidden, visible):
    base = hidden / "bin" / "python3"
    base.parent.mkdir()
    base.symlink_to(REAL_PYTHON)
    script = make_environment(visible / "venv", REAL_PYTHON)
    python = visible / "venv" / "bin" / "python"
    python.unlink()
    python.symlink_to(base)
    assert_refused(script, base, "interpreter")


def test_a_copied_interpreter_whose_base_is_hidden_is_refused(hidden, visible):
    """The links show nothing, but pyvenv.cfg does."""
    script = make_environment(visible / "venv", REAL_PYTHON)
    python = visible / "venv" / "bin" / "python"
    python.unlink()
    python.write_bytes(REAL_PYTHON.read_bytes())
    python.chmod(0o755)
    configuration = visible / "venv" / "pyvenv.cfg"
    check_program(script)
    lines = [line for line in configuration.read_text().splitlines() if not line.startswith("home")]
    configuration.write_text("\n".join([f"home = {hidden / 'python' / 'bin'}", *lines]))
    assert_refused(script, hidden / "python" / "bin", "base")


def test_a_package_in_a_hidden_folder_is_refused(hidden, visible):
    """An editable installation: the environment is visible and only its search path is not."""
    script = make_environment(visible / "venv", REAL_PYTHON)
    (hidden / "checkout" / "optodrive").mkdir(parents=True)
    (hidden / "checkout" / "optodrive" / "__init__.py").touch()
    check_program(script)
    [packages] = (visible / "venv" / "lib").glob("python*/site-packages")
    (packages / "editable.pth").write_text(f"{hidden / 'checkout'}\n")
    assert_refused(script, hidden / "checkout", "imports")


def test_a_program_that_is_not_here_is_judged_by_its_path(hidden, visible):
    check_program(visible / "not" / "yet" / "there")
    assert_refused(hidden / "not" / "yet" / "there", hidden)


def test_links_in_a_circle_end(hidden, visible):
    (visible / "a").symlink_to(visible / "b")
    (visible / "b").symlink_to(visible / "a")
    check_program(visible / "a")
