"""What is asked on a terminal."""

import sys

from mmwave_env.logs.lines import number

PROMPT = "Enter current speed (m/s): "


def parse_speed(word: str) -> float:
    """A speed in m/s.

    Raises:
        ValueError: not a finite number, or negative.
    """
    speed = number(word.strip())
    if not 0.0 <= speed < float("inf"):
        raise ValueError(f"speed: found {word.strip()!r}, expected a number of m/s, at least 0")
    return speed


def can_ask() -> bool:
    """Whether there is a terminal to ask on."""
    return sys.stdin is not None and sys.stdin.isatty()


def ask_speed() -> float:
    """Ask on the terminal until the answer is a speed (paper, Algorithm 1, Step 1).

    Raises:
        ValueError: there is no answer.
    """
    screen = sys.stderr if sys.stderr.isatty() else sys.stdout
    while True:
        print(PROMPT, end="", file=screen, flush=True)
        answer = sys.stdin.readline()
        if not answer:
            print(file=screen)
            raise ValueError("speed: found the end of the input, expected a number of m/s")
        try:
            return parse_speed(answer)
        except ValueError as error:
            print(error, file=screen)
