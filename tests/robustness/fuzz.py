"""`make fuzz`, or `python -m tests.robustness.fuzz [parser …] [minutes=5]`: every parser gets damaged, hostile files.

Valid files are cut, spliced, flipped and filled with extreme numbers by hypothesis, which shrinks what it finds. A
parser may succeed or raise what it documents; anything else, a hang of 20 s or 4 GB of memory is a failure. Each parser
runs in a process of its own.
"""

import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from time import monotonic

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from tests.robustness.page import write_part
from tests.robustness.parsers import PARSERS, Parser

SECONDS_EACH = 20
MEMORY = 4 * 2**30
BURST = 300
"""Files between looks at the clock."""

EXTREMES = [
    *(b"\x00\x00\x00\x00", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x80\x00\x00\x00"),
    *(
        b"-1",
        b"1e999",
        b"NaN",
        b"99999999999999999999",
        b"null",
        b"[]",
        b"{}",
        b'""',
        b"\xc3\x28",
        b"../../x",
    ),
    *(
        b"${oc.env:HOME}",
        b"_target_: os.system",
        b"!!python/object/apply:os.system [id]",
        b"&a [*a]",
        b"\t",
        b"\n",
    ),
]


@st.composite
def damaged(draw: st.DrawFn, examples: list[bytes]) -> bytes:
    """A valid file after one to five mishaps."""
    content = bytearray(draw(st.sampled_from(examples)))
    for _ in range(draw(st.integers(1, 5))):
        start = draw(st.integers(0, len(content)))
        length = draw(st.integers(0, 64))
        kind = draw(st.sampled_from(["cut", "remove", "flip", "insert", "overwrite", "repeat", "random"]))
        if kind == "cut":
            del content[start:]
        elif kind == "remove":
            del content[start : start + length]
        elif kind == "flip" and start < len(content):
            content[start] ^= 1 << draw(st.integers(0, 7))
        elif kind == "insert":
            content[start:start] = draw(st.sampled_from(EXTREMES))
        elif kind == "overwrite":
            extreme = draw(st.sampled_from(EXTREMES))
            content[start : start + len(extreme)] = extreme
        elif kind == "repeat":
            content[start:start] = content[start : start + length] * draw(st.integers(1, 50))
        else:
            content[start : start + length] = draw(st.binary(max_size=64))
    return bytes(content)


def survives(parser: Parser, files: int, number: int) -> None:
    """Give a parser so many damaged files."""

    @seed(number)
    @settings(
        max_examples=files,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    @given(content=damaged(list(parser.examples())))
    def check(content: bytes) -> None:
        with tempfile.NamedTemporaryFile() as file:
            file.write(content)
            file.flush()
            signal.alarm(SECONDS_EACH)
            try:
                parser.parse(Path(file.name))
            except parser.documented:
                pass
            finally:
                signal.alarm(0)

    check()


def fuzz(parser: Parser, minutes: float) -> int:
    """Damaged files given to a parser within the time."""

    def hang(*_: object) -> None:
        raise TimeoutError(f"{parser.name}: still at one file after {SECONDS_EACH} s")

    signal.signal(signal.SIGALRM, hang)
    resource.setrlimit(
        resource.RLIMIT_AS, (MEMORY + 20 * 2**30, MEMORY + 20 * 2**30)
    )  # torch maps 20 GB unused
    end, files = monotonic() + 60 * minutes, 0
    while monotonic() < end:
        survives(parser, BURST, files)
        files += BURST
    return files


def main(words: list[str]) -> int:
    """Fuzz the parsers named, or all."""
    minutes = next((float(word.partition("=")[2]) for word in words if word.startswith("minutes=")), 5.0)
    names = [word for word in words if not word.startswith("minutes=")]
    by_name = {parser.name: parser for parser in PARSERS}
    if unknown := set(names) - set(by_name):
        sys.exit(f"fuzz: got {', '.join(sorted(unknown))}, expected any of: {', '.join(by_name)}")
    if len(names) == 1 and "--here" in sys.argv:
        print(fuzz(by_name[names[0]], minutes))
        return 0
    rows, failed = [], 0
    for name in names or by_name:
        command = [sys.executable, "-m", "tests.robustness.fuzz", name, f"minutes={minutes}", "--here"]
        done = subprocess.run(command, capture_output=True, text=True)
        failed += done.returncode != 0
        outcome = f"{done.stdout.split()[-1]} files" if done.returncode == 0 else "**failed**"
        print(f"{name}: {outcome}", done.stderr if done.returncode else "", flush=True)
        rows.append(f"| {name} | {minutes:g} | {outcome} |")
    if not names:
        write_part("fuzz", "\n".join(["| parser | minutes | damaged files |", "|---|---|---|", *rows]))
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main([word for word in sys.argv[1:] if word != "--here"]))
