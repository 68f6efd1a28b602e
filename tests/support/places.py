"""Where the repository, its experiments and the shared data are."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENTS = ROOT / "experiments"
# data next to the checkout; tests that need it are skipped without it
SHARED = ROOT.parent / "shared"
SUPPORT = ROOT / "tests" / "support"
