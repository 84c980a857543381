"""Commands and options that are gone, each with what to use instead."""

COMMANDS = {
    "ablate": "docs/learning.md has what was found; the history has the command",
    "association": "localize --associate",
    "benchmark": "speed",
    "collect": "examples/minari.py",
    "completion": "mmwave-loc --tyro-print-completion bash (or zsh, fish)",
    "doctor": "--version --json",
    "extremes": "docs/reliability.md has what was found; the tests try it",
    "inspect": "localize --diagnose",
    "learned": "docs/learning.md has what was found; the history has the command",
    "raytrace": "examples/raytrace.py",
    "record": "a folder of one track, for --data; the history has the command",
    "samples": "list samples; list samples --out FOLDER copies them",
    "soak": "docs/reliability.md has what was found; the tests try it",
    "standardize": "docs/learning.md has what was found; the history has the command",
    "studies": "docs/learning.md has what was found; the history has the command",
    "traffic": "examples/sumo.py",
    "transfer": "leaderboard",
    "tune-imm": "tune --bank",
}
OPTIONS: dict[str, str] = {}
