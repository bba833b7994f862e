"""docs/reliability.md from the rows that the tests have measured: reliability.py FOLDER (see `make reliability`)."""

import json
import sys
from pathlib import Path

HEAD = """# Reliability

Every fault that a test puts there: what is counted, what the user is told, how long until the navigation is back, and what is lost to
the recording. `make reliability` measures all rows anew and writes this page; `make test` checks the same rows without writing.
The counters are keys of the summary ([cli.md](cli.md)); [faults.md](faults.md) says what each means.

- *Counted* is exact: the test knows each frame that it has dropped, damaged, doubled or held up, and the counters must agree with it
  one by one.
- *Told* is on standard error at once; what ground stations must know goes out as STATUSTEXT too.
- *Back* is the time from the end of the fault to the first solution from a sample after it, in seconds, and the mode
  then. After a gap longer than `navigation.gap_interpolate_s` the mode is DEGRADED until the next alignment. Times are those of
  one run on the machine that wrote this page; on a busy machine they are longer, and silences are told that no fault has made.
- *Lost to the recording*: frames that came and are not in the file.

| fault | injected | counted | told | back, s | lost to the recording |
| --- | --- | --- | --- | --- | --- |
"""
TAIL = """
## Your own

Faults of the wire are tables of a scenario, `[[wire]]` ([scenario.md](scenario.md#wire-faults-of-the-wire)), for `hil run`, `hil imu` and the
pytest fixture `hil_bridge`. The summary then has `wire`: `samples` that the head made, `injected` by kind (frames; samples for
`reorder` and `counter-freeze`), `lost` (samples by the kind that lost them) and, for the DTG head, `expected`: what the counters of
the bridge must be. So the balance of a run can be checked:

    samples = received samples + late + each kind of lost

```sh
hil run lossy.toml --duration 20 --mavlink none --json
```

Exact are faults of any kinds at once, but not a counter that stands still or a clock that steps together with losses:
what a driver takes for the one or the other then depends on which samples are missing. A board without counter, clock or check
(SBG, J1939) cannot tell all of them apart: a damaged payload goes through, a clock that steps looks like a gap.

## Soak

`make soak` flies the default scenario at 1 kHz for 30 minutes on vcan0 (in user-mode Linux where the kernel has none), with a random
fault every 5 s. It fails when a single sample or frame is not accounted for, when one is missing in the recording, or when the memory of
a process grows.

```sh
make soak MINUTES=3 ARGS="--seed 7"
make soak MINUTES=3 ARGS="--bus unix:soak --layout classic --rate 250"
```
"""


def main(folder: str) -> None:
    rows = [json.loads(path.read_text()) for path in sorted(Path(folder).glob("*.json"))]
    if not rows:
        sys.exit(f"reliability: no rows in {folder}")
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    print(HEAD + "\n".join(lines) + "\n" + TAIL, end="")


if __name__ == "__main__":
    main(sys.argv[1])
