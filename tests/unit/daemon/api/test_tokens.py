import pytest

from limited_files import largest_file
from optodrive.core.errors import InputError
from optodrive.daemon.api.tokens import (
    ENVIRONMENT_VARIABLE,
    FILE_ENVIRONMENT_VARIABLE,
    build_tokens_path,
    create_tokens,
    load_daemon_tokens,
    read_private_tokens,
    read_token,
    read_tokens,
)

SECRET = "s3cret-s3cret-s3cret"


def write_tokens(path, *entries, version=1):
    lines = [f'format = "optodrive-tokens"\nversion = {version}\n']
    lines += [f'[[token]]\nname = "{name}"\nrole = "{role}"\nsecret = "{secret}"\n' for name, role, secret in entries]
    path.write_text("".join(lines))
    path.chmod(0o600)
    return path


@pytest.fixture(autouse=True)
def _own_place(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.delenv(FILE_ENVIRONMENT_VARIABLE, raising=False)


def test_a_fresh_token_for_each_role_which_only_its_user_may_read(tmp_path):
    tokens, path = load_daemon_tokens("", 8450)
    assert path == build_tokens_path(8450)
    assert path.stat().st_mode & 0o777 == 0o600
    assert [token.role for token in tokens.all] == ["viewer", "operator", "armer"]
    assert len({token.secret for token in tokens.all}) == 3
    again, _ = load_daemon_tokens("", 8450)
    assert not {token.secret for token in again.all} & {token.secret for token in tokens.all}


def test_a_file_that_is_kept_outlives_the_daemon(tmp_path):
    kept = tmp_path / "state" / "tokens.toml"
    tokens, _ = load_daemon_tokens(str(kept), 8450)
    again, _ = load_daemon_tokens(str(kept), 8450)
    assert again.all == tokens.all


def test_the_environment_gives_the_armers(monkeypatch):
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, SECRET)
    tokens, path = load_daemon_tokens("", 1)
    assert tokens.find(SECRET).role == "armer"
    assert read_tokens(path).highest_role.secret == SECRET


@pytest.mark.parametrize(
    ("line", "wrong", "says"),
    [
        ('role = "armer"', 'role = "boss"', "token.0.role: got 'a value that is not shown', expected one of viewer,"),
        (
            f'secret = "{SECRET}"',
            'secret = "short"',
            "token.0.secret: got 'a value that is not shown', expected 16 to",
        ),
        ('name = "anna"', 'name = "a/b"', "token.0.name: got 'a value that is not shown', expected 1 to 40 letters"),
        ('role = "armer"', "", "token.0.role: missing, expected this key"),
        ('role = "armer"', 'rol = "armer"', "token.0.rol: got 'rol', expected "),
    ],
    ids=str,
)
def test_a_wrong_entry_is_named_with_what_is_expected_and_not_shown(tmp_path, line, wrong, says):
    path = write_tokens(tmp_path / "tokens.toml", ("anna", "armer", SECRET))
    path.write_text(path.read_text().replace(line, wrong))
    with pytest.raises(InputError) as caught:
        read_tokens(path)
    assert says in str(caught.value)
    assert not any(text in str(caught.value) for text in (SECRET, "boss", "short'", "a/b", "should"))


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o777])
def test_a_daemons_file_that_others_may_read_is_refused(tmp_path, mode):
    path = write_tokens(tmp_path / "tokens.toml", ("anna", "armer", SECRET))
    assert read_private_tokens(path).find(SECRET).name == "anna"
    path.chmod(mode)
    with pytest.raises(InputError, match="chmod 600"):
        read_private_tokens(path)


def test_only_the_very_secret_is_found(tmp_path):
    tokens = read_tokens(write_tokens(tmp_path / "t.toml", ("anna", "armer", SECRET), ("ben", "viewer", SECRET[::-1])))
    assert tokens.find(SECRET).name == "anna"
    assert tokens.find(SECRET[::-1]).name == "ben"
    for wrong in ("", SECRET[:-1], SECRET + "x", SECRET.upper(), "ü" * 20):
        assert tokens.find(wrong) is None


def test_a_secret_shows_in_no_repr_and_no_error(tmp_path):
    tokens = create_tokens(tmp_path / "t.toml")
    assert all(token.secret not in repr(token) for token in tokens.all)
    short = "tooshort"
    cases = [
        write_tokens(tmp_path / "a.toml", ("anna", "armer", short)),
        write_tokens(tmp_path / "b.toml", ("anna", "chief", SECRET)),
        write_tokens(tmp_path / "c.toml", ("anna", "armer", SECRET), ("anna", "viewer", SECRET + "2")),
        write_tokens(tmp_path / "d.toml", ("anna", "armer", SECRET), ("ben", "viewer", SECRET)),
        write_tokens(tmp_path / "e.toml"),
    ]
    for path in cases:
        with pytest.raises(InputError) as caught:
            read_tokens(path)
        assert SECRET not in str(caught.value)
        assert short not in str(caught.value)
        assert "\n" not in str(caught.value)


def test_another_version_is_refused_by_name(tmp_path):
    with pytest.raises(
        InputError, match="version: got 2, expected 1, the one this release reads; a newer release wrote this file"
    ):
        read_tokens(write_tokens(tmp_path / "t.toml", ("anna", "armer", SECRET), version=2))


@pytest.mark.parametrize(
    ("entries", "version", "named"),
    [((("anna", "armer", SECRET),), 2, "version: got 2"), ((), 1, "token: missing"), ((("a", "b", "c"),), 1, "role: ")],
)
def test_a_caller_is_told_what_is_wrong_with_its_file(tmp_path, monkeypatch, entries, version, named):
    path = write_tokens(tmp_path / "t.toml", *entries, version=version)
    monkeypatch.setenv(FILE_ENVIRONMENT_VARIABLE, str(path))
    with pytest.raises(InputError, match=named):
        read_token(8450)


def test_a_caller_uses_whichever_is_there(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=f"set it, name a file of tokens by {FILE_ENVIRONMENT_VARIABLE}, or make "):
        read_token(8450)
    tokens, _ = load_daemon_tokens("", 8450)
    assert read_token(8450) == tokens.find(tokens.all[2].secret).secret == tokens.all[2].secret
    given = write_tokens(tmp_path / "mine.toml", ("ben", "viewer", SECRET))
    monkeypatch.setenv(FILE_ENVIRONMENT_VARIABLE, str(given))
    assert read_token(8450) == read_token(None) == SECRET
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, "another")
    assert read_token(8450) == "another"


def test_a_given_secret_is_kept_as_it_is_or_refused_without_being_shown(tmp_path):
    sign = 'sixteen"\\signs-and#more'
    assert create_tokens(tmp_path / "a.toml", sign).find(sign).role == "armer"
    assert read_tokens(tmp_path / "a.toml").find(sign).role == "armer"
    for wrong in ("tooshort-token", "sixteen signs and more", "x" * 201, "sixteen-signs-ünd-more"):
        with pytest.raises(InputError, match=ENVIRONMENT_VARIABLE) as caught:
            create_tokens(tmp_path / "b.toml", wrong)
        assert wrong not in str(caught.value)
        assert not (tmp_path / "b.toml").exists()


def test_a_full_disk_leaves_no_part_of_the_daemons_tokens(tmp_path):
    path = tmp_path / "tokens.toml"
    with largest_file(20), pytest.raises(InputError, match="got 'File too large'"):
        load_daemon_tokens(str(path), 1)
    assert list(tmp_path.glob("*tokens*")) == []
    tokens, _ = load_daemon_tokens(str(path), 1)  # the next start creates them
    content = path.read_bytes()
    with largest_file(20), pytest.raises(InputError, match="got 'File too large'"):
        create_tokens(path)
    assert path.read_bytes() == content
    assert load_daemon_tokens(str(path), 1)[0].all == tokens.all
