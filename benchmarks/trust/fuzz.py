"""Coverage-guided fuzzing of one target with atheris (`pip install .[fuzz]`).

    python -m benchmarks.trust.fuzz session_log -max_total_time=60

Options after the target are libFuzzer's. An input that breaks a promise is kept in a file `crash-...`.
"""

from __future__ import annotations

import sys


def main() -> None:
    """Instrument, import, fuzz."""
    try:
        import atheris  # type: ignore[import-untyped, import-not-found]
    except ImportError:
        raise SystemExit("atheris is not installed; `pip install .[fuzz]`, or use `trust input`") from None
    with atheris.instrument_imports(include=["fri", "lwr_driver", "ident", "sim_backend", "runner"]):
        from benchmarks.trust import targets

        if len(sys.argv) < 2 or sys.argv[1] not in targets.TARGETS:
            raise SystemExit(f"name a target: {', '.join(targets.TARGETS)}")
        name = sys.argv.pop(1)
        corpus = targets.corpus(name)
        # What a target imports on its way is instrumented too.
        for data in corpus:
            targets.check(name, data)

    def once(data: bytes) -> None:
        # The first byte chooses a good input, the next ones where and what is put over it.
        if corpus and len(data) > 5 and data[0] < 200:
            base = bytearray(corpus[data[0] % len(corpus)])
            place = int.from_bytes(data[1:5], "little") % max(len(base), 1)
            base[place : place + len(data) - 5] = data[5:]
            data = bytes(base)
        answer = targets.check(name, data)
        if answer not in ("ok", "refused"):
            raise RuntimeError(answer)

    atheris.Setup(sys.argv, once)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
