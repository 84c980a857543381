"""mmwave-loc completion, as a shell reads it."""

import shutil
import subprocess

import pytest

from tests.cli import assert_one_clear_line, command, succeed


def completed(script, *words):
    """What bash offers for the last word."""
    typed = " ".join(f"'{word}'" for word in words)
    code = (
        f"source '{script}'; COMP_WORDS=(mmwave-loc {typed}); COMP_CWORD={len(words)}; "
        "f=$(complete -p mmwave-loc | sed 's/.*-F \\([^ ]*\\).*/\\1/'); "
        f'$f mmwave-loc "${{COMP_WORDS[-1]}}" "${{COMP_WORDS[-2]}}"; echo "${{COMPREPLY[@]}}"'
    )
    return subprocess.run(["bash", "-c", code], capture_output=True, text=True).stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_and_choices(tmp_path, monkeypatch):
    pytest.importorskip("shtab")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", "/usr/bin/bash")
    said = succeed("completion")
    script = tmp_path / ".local/share/bash-completion/completions/mmwave-loc"
    assert str(script) in said and "new shell" in said
    assert completed(script, "loc") == ["localize"]
    assert completed(script, "compare", "--pol") == ["--policies"]
    assert "--quiet" in completed(script, "compare", "--q")
    assert "ppo" in completed(script, "train", "--algo", "")


def test_zsh_gets_a_function_of_its_own(tmp_path):
    pytest.importorskip("shtab")
    succeed("completion", "--shell", "zsh", "--out", tmp_path / "_mmwave-loc")
    content = (tmp_path / "_mmwave-loc").read_text()
    assert content.startswith("#compdef mmwave-loc") and "--decisions" in content


def test_an_unknown_shell_is_named(monkeypatch):
    pytest.importorskip("shtab")
    monkeypatch.setenv("SHELL", "/bin/tcsh")
    assert_one_clear_line(command("completion"), "shell: found 'tcsh', expected one of bash, zsh")
