"""Is a manifest fit to train on? Every file is decoded, every rule checked, and the result is one report."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import SPLITS
from anytouch_jax.data.prepare import checks
from anytouch_jax.data.prepare.checks import Finding, split_hash
from anytouch_jax.data.prepare.licences import NO, YES, Licence, licences
from anytouch_jax.data.prepare.scan import Scan, scan
from anytouch_jax.data.prepare.swapped import swapped

__all__ = ["Finding", "Report", "split_hash", "verify"]

_SHARES = ("image_path", "text", "touch", "object", "background_path", "license")
_ROWS = 1000  # row numbers of a finding that are written to JSON


@dataclass(frozen=True)
class Report:
    """What `verify` found: `scan` tells of the files, `shares` per dataset the share of rows that have a value."""

    rows: int
    files: int
    decoded: bool
    findings: tuple[Finding, ...]
    licences: tuple[Licence, ...]
    shares: dict[str, dict[str, float]]
    splits: dict[str, int]
    split_hash: str
    content_hash: str
    scan: Scan

    @property
    def ok(self) -> bool:
        """Whether there is no error (warnings may be there)."""
        return not any(finding.level == "error" for finding in self.findings)

    def to_json(self) -> str:
        """The report as JSON; of each finding the first thousand row numbers."""
        findings: list[dict[str, Any]] = [
            {
                "kind": f.kind, "level": f.level, "sentence": f.sentence, "column": f.column, "count": int(f.rows.size),
                "rows": f.rows[:_ROWS].tolist(), "examples": list(f.examples),
            }
            for f in self.findings
        ]  # fmt: skip
        about = {
            "rows": self.rows, "files": self.files, "decoded": self.decoded, "ok": self.ok,
            "content_hash": self.content_hash, "split_hash": self.split_hash, "splits": self.splits,
            "shares": self.shares, "licences": [licence._asdict() for licence in self.licences], "findings": findings,
        }  # fmt: skip
        return json.dumps(about, indent=1, ensure_ascii=False) + "\n"

    def to_markdown(self) -> str:
        """The report as a page to read."""
        how = "every picture decoded" if self.decoded else "pictures not decoded"
        lines = [
            f"{self.rows} rows, {self.files} files ({how})", "",
            f"content {self.content_hash[:16]}, splits {self.split_hash[:16]}: "
            + ", ".join(f"{name} {count}" for name, count in self.splits.items()), "",
        ]  # fmt: skip
        for finding in self.findings:
            lines.append(f"* **{finding.level}** `{finding.kind}`: {finding.sentence}")
            lines += [f"  * {example}" for example in finding.examples]
        lines += ["" if self.findings else "No fault was found.\n"]
        lines += ["| dataset | " + " | ".join(_SHARES) + " |", "|---" * (len(_SHARES) + 1) + "|"]
        lines += [
            f"| {name} | " + " | ".join(f"{share[column]:.0%}" for column in _SHARES) + " |"
            for name, share in self.shares.items()
        ]
        lines += ["", "| licence | commercial | rows | datasets |", "|---|---|---|---|"]
        use = {YES: "yes", NO: "no"}
        lines += [
            f"| {licence.name or '-'} | {use.get(licence.commercial, 'unknown')} | {licence.rows} | "
            f"{', '.join(licence.datasets[:8])}{' ...' if len(licence.datasets) > 8 else ''} |"
            for licence in self.licences
        ]
        return "\n".join(lines) + "\n"


def verify(
    manifest: Manifest,
    *,
    decode: bool = True,
    objects: bool = False,
    threads: int = 4,
    log: Callable[[str], None] | None = None,
) -> Report:
    """Check a manifest and every file that it names.

    `decode`: read every file and decode every picture whole; else only see that files are there and not empty.
    `objects`: an object on both sides of a split is an error, not information. Faults in the data are findings of
    the report; nothing of the manifest is changed (see `repair`).
    """
    found = scan(manifest, decode=decode, threads=threads, log=log)
    findings = [
        *checks.bad_files(manifest, found),
        *checks.wrong_sizes(manifest, found),
        *checks.duplicates(manifest, found),
        *swapped(manifest, found),
        *checks.split_leaks(manifest, objects=objects),
        *checks.frame_order(manifest),
        *checks.misspelt_sensors(manifest),
        *checks.licence_conflicts(manifest),
    ]
    levels = ("error", "warning", "info")
    counts = {entry["values"]: entry["counts"] for entry in pc.value_counts(manifest.table["split"]).to_pylist()}
    return Report(
        rows=len(manifest),
        files=len(found.files),
        decoded=decode,
        findings=tuple(sorted(findings, key=lambda finding: levels.index(finding.level))),
        licences=licences(manifest),
        shares=_shares(manifest),
        splits={name: counts[name] for name in SPLITS if name in counts},
        split_hash=split_hash(manifest),
        content_hash=manifest.content_hash,
        scan=found,
    )


def _shares(manifest: Manifest) -> dict[str, dict[str, float]]:
    dataset = manifest.codes("dataset")
    present = {name: manifest.present(name) for name in _SHARES}
    shares = {}
    for code in np.unique(dataset):
        rows = np.flatnonzero(dataset == code)
        name = str(manifest.value(rows[0], "dataset") or "-")
        shares[name] = {column: float(there[rows].mean()) for column, there in present.items()}
    return shares
