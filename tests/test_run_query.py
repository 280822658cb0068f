"""Ranges, times and conditions as people type them."""

import math
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spherloc.errors import InputError
from spherloc_viz.recording.index.query import MAX_TEXT, Range, RunQuery, parse_range, parse_when
from spherloc_viz.recording.index.steps import COLUMNS, WORDS, checked_condition

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)


@pytest.mark.parametrize(
    "text, expected",
    [
        (">0.9", Range(low=0.9, low_open=True)),
        (" >= 0.9 ", Range(low=0.9)),
        ("<3", Range(high=3.0, high_open=True)),
        ("<=.5", Range(high=0.5)),
        ("0.5..0.9", Range(0.5, 0.9)),
        ("-1 .. 2e3", Range(-1.0, 2000.0)),
        ("5..5", Range(5.0, 5.0)),
        ("<-1e-3", Range(high=-0.001, high_open=True)),
    ],
)
def test_ranges(text: str, expected: Range):
    assert parse_range(text) == expected


@pytest.mark.parametrize(
    "text, inside, outside", [("0.9", 1 - 10 / 100, 0.89), ("52", 52, 51), ("-3", -3.0, -3.1), ("0", 0, 1e-9)]
)
def test_a_number_alone_is_itself(text: str, inside: float, outside: float):
    found = parse_range(text)
    assert found.low <= inside <= found.high
    assert not found.low <= outside <= found.high


@pytest.mark.parametrize(
    "text",
    [
        "",
        ">",
        "0.9..",
        "..",
        "0.9..0.5",
        "=3",
        "a",
        ">nan",
        "inf",
        "1e999",
        "1..2..3",
        ">0.9<1",
        "1e9999..2",
        "٣",
        "> 1 2",
        "0x10",
    ],
)
def test_what_is_no_range_is_a_sentence(text: str):
    with pytest.raises(InputError, match=r"\.$"):
        parse_range(text)


@given(st.text(max_size=20) | st.from_regex(r"[<>=.0-9e+-]{1,12}", fullmatch=True))
def test_any_text_is_a_range_or_a_sentence(text: str):
    try:
        found = parse_range(text)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert not math.isnan(found.low) and not math.isnan(found.high) and found.low <= found.high


@pytest.mark.parametrize(
    "text, end, expected",
    [
        ("2026-01-31", False, "2026-01-31T00:00:00.000+00:00"),
        ("2026-01-31", True, "2026-02-01T00:00:00.000+00:00"),
        ("2026-01-31T08:30", True, "2026-01-31T08:30:00.000+00:00"),
        ("2026-01-31T08:30:00+02:00", False, "2026-01-31T06:30:00.000+00:00"),
        ("2h", False, "2026-03-01T10:00:00.000+00:00"),
        (" 3d ", True, "2026-02-26T12:00:00.000+00:00"),
        ("90min", False, "2026-03-01T10:30:00.000+00:00"),
        ("1w", False, "2026-02-22T12:00:00.000+00:00"),
    ],
)
def test_times(text: str, end: bool, expected: str):
    assert parse_when(text, NOW, end) == expected


@pytest.mark.parametrize(
    "text", ["", "yesterday", "2026-13-01", "3", "3 months", "-2h", "9999-12-31", "0001-01-01T00:00+14:00"]
)
def test_what_is_no_time_is_a_sentence(text: str):
    with pytest.raises(InputError, match="is not a time"):
        parse_when(text, NOW, end=True)


@given(st.timedeltas(timedelta(days=-9000), timedelta(days=9000)))
def test_times_sort_as_texts(step: timedelta):
    when = (NOW + step).replace(microsecond=0)
    assert (parse_when(when.isoformat(), NOW) < parse_when("2026-03-01T12:00", NOW)) == (when < NOW)


def test_a_text_has_a_limit():
    RunQuery(text="x" * MAX_TEXT)
    with pytest.raises(InputError, match="cannot be searched for"):
        RunQuery(text="x" * (MAX_TEXT + 1))


@pytest.mark.parametrize(
    "text",
    [
        "position_error_m < 0.1 AND stage = 'Refinement'",
        "step BETWEEN 3 and 4 or not (agreeing >= 0.5*correspondences)",
        "stage = 'it''s' and key like '%-pose' and scene <> 'select 1; drop'",
        "diagnosis in ('ambiguous', 'ok') and rotation_error_deg is not null",
        "agreeing / 2 - 1 > -1e-3 % 7",
    ],
)
def test_conditions(text: str):
    assert checked_condition(text).split() != []


@pytest.mark.parametrize(
    "text",
    [
        "(select 1) = 1",
        "stage in (select stage from runs)",
        "step = 1; create external table t stored as csv location '/etc/passwd'",
        "step = 1 union all select 1",
        "read_csv('/etc/passwd') is null",
        '"step" = 1',
        "step = $1",
        "step = 1 -- comment",
        "step = 1 /* comment */",
        "case when true then step end = 1",
        "cast(step as text) = 'a'",
        "runs.step = 1",
        "stage = 'open",
        "exists (values (1))",
        "stage = x'41'",
        "step::text = 'a'",
        "step = 1\x00",
        "st\u00e9p = 1",
        "1e5x = step",
        "",
        "   ",
        "(" * 51 + "step = 1" + ")" * 51,
        "step = 1 or " * 200 + "true",
    ],
)
def test_what_is_more_than_a_condition_is_a_sentence(text: str):
    with pytest.raises(InputError) as caught:
        checked_condition(text)
    assert "\n" not in str(caught.value)


PIECES = [*COLUMNS, *WORDS, "'a'", "1.5", "<", "-", "/", "*", "(", ")", "--", "/*", ";"]


@given(st.text(max_size=60) | st.lists(st.sampled_from(PIECES), max_size=9).map("".join))
def test_any_text_is_a_condition_or_a_sentence(text: str):
    try:
        checked = checked_condition(text)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        outside = "".join(checked.split("'")[::2])
        assert ";" not in outside and "--" not in outside and "/*" not in outside
