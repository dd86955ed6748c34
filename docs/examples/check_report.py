"""Works out every number of a campaign's report again, from the campaign's own files, and compares.

    PYTHONPATH=python/src python3 docs/examples/check_report.py DIR

Shares no code with the program that wrote the report. Exit code 1 if a number differs, or cannot be worked out.
"""

import html.parser
import math
import pathlib
import statistics
import sys

from retrograde.data import Campaign


def line(points):
    """Slope and intercept of the line through the means of the clampings, because trials of one clamping share its
    error; R^2 and residual deviation of the trials about it."""
    by_a = {}
    for x, y in points:
        by_a.setdefault(x, []).append(y)
    if len(by_a) < 2:
        return None
    means = {x: statistics.fmean(ys) for x, ys in by_a.items()}
    n, middle = len(points), statistics.fmean(means)
    squares_x = math.fsum((x - middle) ** 2 for x in means)
    # `statistics.linear_regression` needs Python 3.10.
    slope = math.fsum((x - middle) * y for x, y in means.items()) / squares_x
    intercept = statistics.fmean(means.values()) - slope * middle

    def left(points):
        return math.fsum((y - intercept - slope * x) ** 2 for x, y in points)

    mean_y = statistics.fmean(y for _, y in points)
    squares_y = math.fsum((y - mean_y) ** 2 for _, y in points)
    return {
        "n": n,
        "slope": slope,
        "intercept_mm": intercept,
        "r_squared": 1 - left(points) / squares_y if squares_y else None,
        "residual_sd_mm": math.sqrt(left(points) / (n - 2)) if n > 2 else None,
    }


def planned_mm(action, time_s):
    """Position of the plan: ramps of constant acceleration, dwells at both ends."""
    screw, run, plan = action["screw"], action["requested"], action["achieved"]
    per_step = screw["lead_um"] / screw["steps_per_rev"] / 1000
    at, position = run["start_delay_us"] * 1e-6, 0.0
    for number in range(2 * run["cycles"]):
        out = number % 2 == 0
        stroke = plan["forward"] if out else plan["back"]
        length, t, r = stroke["steps"] * per_step, stroke["duration_ticks"] * 1e-8, stroke["ramp_ticks"] * 1e-8
        if number == 2 * run["cycles"] - 1:
            at = plan["total_ticks"] * 1e-8 - t
        since = min(max(time_s - at, 0.0), t)
        acceleration = length / (t - r) / r
        way = (
            acceleration * since**2 / 2
            - (acceleration * (since - r) ** 2 / 2 if since > r else 0)
            - (acceleration * (since - (t - r)) ** 2 / 2 if since > t - r else 0)
        )
        position += way if out else -way
        at += t + (run["far_dwell_us"] if out else run["home_dwell_us"]) * 1e-6
    return position


def deviation_mm(record):
    """Largest difference of a sample from the plan."""
    action = record.sidecar["action"]
    # An event without parts is a text: `"link_lost"`.
    whats = [(event["time_us"], event["what"]) for event in record.sidecar["events"]]
    starts = [time_us for time_us, what in whats if isinstance(what, dict) and "run_started" in (what.get("rig") or {})]
    if not action["achieved"] or not action["executed"] or action["executed"]["holds"] or not starts:
        return None
    screw = action["screw"]
    per_step = screw["lead_um"] / screw["steps_per_rev"] / 1000
    return max(
        abs(row["position_steps"] * per_step - planned_mm(action, (row["time_us"] - starts[0]) * 1e-6))
        for row in record.telemetry
    )


def expected(campaign):
    """Every number of the report by its place."""
    numbers = {}
    changed = campaign.changed()
    trials = []
    for trial in campaign.trials:
        number = trial["trial"]
        records = campaign.records(number)
        run = campaign.run(number)
        folder = campaign.attempt_folder(number)
        inside = "" if folder is None else folder.relative_to(campaign.folder).as_posix() + "/"
        whole = inside and campaign.whole(number) and not any(name.startswith(inside) for name in changed)
        trial = dict(trial, counts=bool(trial["status"] == "done" and run and whole))
        facts = {"indentation_mm": trial["indentation_mm"], "displacement_mm": trial["displacement_mm"]}
        if run and run.sidecar["action"]["executed"]:
            action = run.sidecar["action"]
            done = action["executed"]
            facts.update(
                planned_steps=action["achieved"]["edges"],
                samples=len(run.telemetry),
                commanded_steps=done["commanded_edges"],
                counted_steps=done["counted_edges"],
                worst_residual_steps=done["worst_residual_steps"],
                greatest_deviation_mm=deviation_mm(run),
                late_ticks=done["ticks"] - action["achieved"]["total_ticks"],
                glitches=done["glitches"],
                holds=done["holds"],
                lost_samples=sum(row["missed"] for row in run.telemetry),
            )
        energies = [
            record.sidecar["action"]["record"]["energy_mj"]
            for record in records
            if record.kind == "actuation" and record.sidecar["action"]["record"]
        ]
        facts["energy_mj"] = sum(energies) if energies else None
        trial["facts"] = facts
        trials.append(trial)
        numbers.update({f"trials/{number}/{name}": fact for name, fact in facts.items()})

    conditions = {}
    for trial in trials:
        key = "/".join([trial["purpose"], trial["lubrication"], str(trial["indentation"]), trial["shape"]])
        conditions.setdefault(key, []).append(trial)
    for key, members in conditions.items():
        counted = [trial for trial in members if trial["counts"]]
        displacements = [trial["displacement_mm"] for trial in counted]
        indentations = [trial["indentation_mm"] for trial in counted if trial["indentation_mm"] is not None]
        for name, fact in {
            "planned": len(members),
            "n": len(counted),
            "mean_mm": statistics.fmean(displacements) if displacements else None,
            "sd_mm": statistics.stdev(displacements) if len(displacements) > 1 else None,
            "indentation_mm": statistics.fmean(indentations) if indentations else None,
        }.items():
            numbers[f"conditions/{key}/{name}"] = fact

    for walls in ("dry", "lubricated"):
        points = [
            (trial["indentation_mm"], trial["displacement_mm"])
            for trial in trials
            if trial["counts"] and trial["purpose"] == "series" and trial["lubrication"] == walls
            and trial["indentation_mm"] is not None
        ]
        for name, fact in (line(points) or {}).items():
            numbers[f"lines/{walls}/{name}"] = fact

    sets = {}
    for row in campaign.readings:
        values = sets.setdefault(row["readings_set"], {"values": [], "quantity": row["quantity"], "good": False})
        if row["event"] == "reading":
            values["values"].append(row["value_mm"])
        elif row["event"] == "withdrawn":
            values["values"].pop()
        elif row["event"] == "accepted":
            # One that is discarded later stays valid for the trials that used it.
            values["good"] = True
    good = {number: one for number, one in sets.items() if one["good"]}
    widths = [statistics.fmean(one["values"]) for one in good.values() if one["quantity"] == "width"]
    for number, one in good.items():
        values = one["values"]
        mean = statistics.fmean(values)
        numbers.update({
            f"readings/{number}/n": len(values),
            f"readings/{number}/mean_mm": mean,
            f"readings/{number}/sd_mm": statistics.stdev(values) if len(values) > 1 else None,
            f"readings/{number}/spread_mm": max(values) - min(values),
        })
        if one["quantity"] == "between_crests" and widths:
            numbers[f"readings/{number}/indentation_mm"] = (widths[-1] - mean) / 2

    def facts(name):
        return [trial["facts"][name] for trial in trials if trial["facts"].get(name) is not None]

    numbers["totals/planned"] = len(trials)
    numbers["totals/counted"] = sum(trial["counts"] for trial in trials)
    numbers["totals/run"] = len(facts("counted_steps"))
    numbers["totals/attempts"] = sum(len(trial["attempts"]) for trial in trials)
    for name in ("commanded_steps", "counted_steps", "glitches", "holds", "lost_samples", "energy_mj"):
        numbers[f"totals/{name}"] = sum(facts(name))
    numbers["totals/worst_residual_steps"] = max(map(abs, facts("worst_residual_steps")), default=None)
    numbers["totals/greatest_deviation_mm"] = max(facts("greatest_deviation_mm"), default=None)
    return numbers


class Shown(html.parser.HTMLParser):
    """The numbers of a page with their places."""

    def __init__(self):
        super().__init__()
        self.numbers, self.place = [], None

    def handle_starttag(self, tag, attributes):
        self.place = dict(attributes).get("data-is")

    def handle_data(self, text):
        if self.place is not None:
            self.numbers.append((self.place, text))
            self.place = None


def main(folder):
    campaign = Campaign(folder)
    numbers = expected(campaign)
    shown = Shown()
    shown.feed((pathlib.Path(folder) / "report" / "report.html").read_text(encoding="utf-8"))
    wrong = []
    for place, text in shown.numbers:
        ours = numbers.get(place)
        decimals = len(text.partition(".")[2])
        if ours is None:
            wrong.append(f"{place}: the page says {text}, nothing is known of it")
        elif abs(float(text) - ours) > 0.5000001 * 10**-decimals + 1e-9 * (decimals > 0):
            wrong.append(f"{place}: the page says {text}, it is {ours:.{decimals + 3}f}")
    for complaint in wrong:
        print(complaint, file=sys.stderr)
    if not shown.numbers:
        print("the page shows no number", file=sys.stderr)
        return 1
    print(f"{len(shown.numbers)} numbers of the page worked out again, {len(wrong)} differ; origin {campaign.origin}")
    return 1 if wrong else 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("which campaign? python3 check_report.py DIR")
    sys.exit(main(sys.argv[1]))
