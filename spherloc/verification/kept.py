"""Stores findings in a file, so that the page can also show those of earlier runs of the command."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from spherloc.errors import InputError
from spherloc.verification.checks import Finding
from spherloc.verification.claims import CLAIMS, Checked, Verdict
from spherloc.verification.experiments import METHODS
from spherloc.verification.measured import SweepPoint


def kept_text(checked: Sequence[Checked]) -> str:
    """The verdicts on the claims as JSON."""
    return json.dumps([_record(item) for item in checked], indent=1, ensure_ascii=False) + "\n"


def with_kept(checked: Sequence[Checked], text: str, where: str) -> list[Checked]:
    """The claims; those that were not run get the verdict in the JSON ``text`` of an earlier run of the command, unless
    the claim has changed. Raises ``InputError``, naming ``where``, for a text that ``kept_text`` did not write."""
    try:
        records = {str(record["key"]): record for record in json.loads(text)}
        earlier = {claim.key: _restored(claim.key, records[claim.key]) for claim in CLAIMS if claim.key in records}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{where}: is not a result of spherloc verify; move it, or give another --output.") from None
    found = []
    for item in checked:
        old = earlier.get(item.claim.key) if item.verdict == Verdict.NOT_RUN else None
        found.append(item if old is None or old.verdict == Verdict.NOT_RUN else old)
    return found


def _record(item: Checked) -> dict[str, Any]:
    return {
        "key": item.claim.key,
        "place": item.claim.place,
        "claim": item.claim.sentence,
        "paper": item.claim.paper,
        "verdict": item.verdict.value,
        "condition": item.condition,
        "as_printed": _finding_record(item.printed),
        "under_the_condition": _finding_record(item.other),
    }


def _finding_record(finding: Finding | None) -> dict[str, Any] | None:
    if finding is None:
        return None
    place = finding.decided_by
    decided = None if place is None else [place.experiment, place.camera, place.method, place.value]
    return {"holds": finding.holds, "found": finding.ours, "decided_by": decided, "seed": finding.seed}


def _restored(key: str, record: Mapping[str, Any]) -> Checked | None:
    """The verdict in a record; None if its claim has changed since."""
    claim = next(claim for claim in CLAIMS if claim.key == key)
    if (record["claim"], record["paper"]) != (claim.sentence, claim.paper):
        return None
    printed, other = _restored_finding(record["as_printed"]), _restored_finding(record["under_the_condition"])
    checked = Checked(claim, Verdict(record["verdict"]), str(record["condition"]), printed, other)
    return replace(checked, earlier=True)


def _restored_finding(record: Mapping[str, Any] | None) -> Finding | None:
    if record is None:
        return None
    place = None
    if record["decided_by"] is not None:
        experiment, camera, method, value = record["decided_by"]
        place = SweepPoint(str(experiment), str(camera), str(method), float(value)) if method in METHODS else None
    return Finding(bool(record["holds"]), str(record["found"]), place, int(record["seed"]))
