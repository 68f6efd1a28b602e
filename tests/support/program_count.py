"""A pytest plugin that counts compiled programs, and fails a run of tests that compiles too many.

An operation of jax outside `jax.jit` is a program for each new shape, some 30 ms each. Compute what
a test expects with numpy, and call what it tests through one `jax.jit` with inputs of one shape.
"""

from collections import Counter

import jax
import pytest

COMPILED = "/jax/core/compile/backend_compile_duration"  # of programs from the cache too
# Of all quick tests together.
LIMIT = 9_000


class ProgramCount:
    """Count the programs of each test. Workers send theirs to the process that started them."""

    def __init__(self) -> None:
        self.tests: Counter[str] = Counter()
        self.names: Counter[str] = Counter()
        self.test = "before the tests"
        jax.monitoring.register_event_duration_secs_listener(self.compiled)

    def compiled(self, event: str, seconds: float, **about: object) -> None:
        if event == COMPILED:
            self.tests[self.test] += 1
            self.names[str(about.get("fun_name"))] += 1

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.test = nodeid

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: pytest.Session) -> None:
        tests, names = getattr(node, "workeroutput", {}).get("programs", ({}, {}))
        self.tests.update(tests)
        self.names.update(names)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["programs"] = dict(self.tests), dict(self.names)
        elif (
            session.config.option.markexpr == "not slow"
            and self.tests.total() > LIMIT
            and not session.exitstatus
        ):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        write = terminalreporter.write_line
        most = self.tests.total() > LIMIT
        write(
            f"{self.tests.total()} compiled programs, of at most {LIMIT} of all quick tests",
            red=most,
        )
        if terminalreporter.config.option.verbose > 0 or most:
            for counts in (self.tests, self.names):
                for name, count in counts.most_common(20):
                    write(f"{count:6} {name}")
