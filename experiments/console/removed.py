"""Commands and options that are gone, each with what to use instead."""

COMMANDS = {
    "ablate": "docs/learning.md has what was found; the history has the command",
    "association": "localize --associate",
    "benchmark": "speed",
    "collect": "python examples/minari_collect.py (in a checkout)",
    "completion": "mmwave-loc --tyro-print-completion bash (or zsh, fish)",
    "doctor": "--version --json",
    "extremes": "docs/reliability.md has what was found; the tests try it",
    "inspect": "localize --diagnose",
    "learned": "docs/learning.md has what was found; the history has the command",
    "raytrace": "python examples/raytrace.py (in a checkout)",
    "record": "read_deepmimo(folder, users=...) in Python, docs/deepmimo.md",
    "samples": "list samples; list samples --out FOLDER copies them",
    "soak": "docs/reliability.md has what was found; the tests try it",
    "standardize": "docs/learning.md has what was found; the history has the command",
    "studies": "docs/learning.md has what was found; the history has the command",
    "traffic": "python examples/sumo.py (in a checkout)",
    "transfer": "leaderboard",
    "tune-imm": "tune --bank",
}
OPTIONS = {
    "--alert-limit": "--percentiles tells protection levels and how often errors exceed them",
    "--clearest": "name an episode with --seed or --key",
    "--decisions": "--epochs-parquet has what every policy chose in every epoch",
    "--engine": "a sweep runs on Ray, on one machine or by --address on a cluster",
    "--figure": "--episodes-csv of several runs has what performance profiles are made of",
    "--format": "simulate writes a log with scene and truth, which --data and localize take",
    "--keys": "watch --key plays an episode by its key, as env.reset does",
    "--stanford": "--percentiles tells protection levels and how often errors exceed them",
    "--trust-zip": "convert makes a policy file of a model; module:function plays others",
    "--training": "docs/performance.md has the figures",
}
