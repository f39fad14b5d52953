"""What a run left, finished or not: signals and numbers, or one sentence on why there are none."""
import json
import os
import sys

from shared.signals import whole_rows


class Missing(Exception):
    """Why a run has nothing for a section: one sentence."""


def fail(message):
    sys.exit(f"report: error: {message}")


def signals_path(directory):
    """signals.csv, or signals.csv.part of a run that is at work, was stopped or failed."""
    path = os.path.join(directory, "signals.csv")
    if not os.path.isdir(directory):
        fail(f"there is no directory {directory}; name the -output_dir of a run")
    if not os.path.exists(path):
        path += ".part"
    if not os.path.exists(path):
        fail(f"neither signals.csv nor signals.csv.part is in {directory}; this is no directory of a run")
    return path


def numbers_of(path):
    """Columns of a table of signals: name -> list (numbers, but text for the phase)."""
    rows = whole_rows(path)
    if not rows or "time_s" not in rows[0] or "volume_ml" not in rows[0]:
        fail(f"{path} holds no steps of pulmo")
    try:
        return {name: [row[name] if name == "phase" else float(row[name]) for row in rows] for name in rows[0]}
    except (TypeError, ValueError):
        fail(f"{path} is damaged: a value is missing or not a number")


def of_json(directory, name):
    """What a file of the run says; None if it is not there."""
    path = os.path.join(directory, name)
    try:
        with open(path) as f:
            return json.load(f)
    except FileNotFoundError:
        return None
    except ValueError as error:
        fail(f"{path} is damaged: {error}")


def read_scene(directory):
    """What a run says of its scene when it begins; empty if it says nothing (an older version of pulmo)."""
    return of_json(directory, "scene.json") or {}


def read_summary(directory, end):
    """What summary.json says, or failure.json, and why the run is not finished (empty if it is). `end`: of its rows, s."""
    for name in "summary.json", "failure.json":
        summary = of_json(directory, name)
        if summary is None:
            continue
        return summary, f"FAILED: {summary.get('failure', 'no reason given')}" if name == "failure.json" else ""
    return {}, f"NOT FINISHED: at work, stopped or killed; rows up to {end:g} s"


def phase_spans(signals):
    """(name, begin, end) of each phase; a row at a switch belongs to the phase that ends."""
    time, phase = signals["time_s"], signals["phase"]
    spans = []
    for i in range(1, len(time)):
        if not spans or phase[i] != spans[-1][0]:
            spans.append([phase[i], time[i - 1], time[i]])
        spans[-1][2] = time[i]
    return spans
