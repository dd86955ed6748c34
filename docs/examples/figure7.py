"""Draws figure 7, displacement over indentation, from the folder of a campaign.

    PYTHONPATH=python/src python3 docs/examples/figure7.py DIR [FILE.svg]

Needs nothing but Python; with matplotlib installed the ending may also be .png or .pdf.
"""

import collections
import html
import math
import pathlib
import statistics
import sys

from retrograde.data import Campaign

Line = collections.namedtuple("Line", "slope intercept")
COLOURS = {"dry": "#c06a10", "lubricated": "#1f5aa8"}


def series(campaign):
    """The trials that count and are as they were written: (a, displacement) in mm by the state of the walls."""
    points = {}
    for trial in campaign.counted():
        if trial["purpose"] == "series" and trial["indentation_mm"] is not None:
            points.setdefault(trial["lubrication"], []).append((trial["indentation_mm"], trial["displacement_mm"]))
    return points


def means(points):
    """(a, mean, standard deviation or 0) of each indentation."""
    by_a = {}
    for a, displacement in points:
        by_a.setdefault(a, []).append(displacement)
    return [
        (a, statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else 0.0)
        for a, values in sorted(by_a.items())
    ]


def line(points):
    """The line through the means of the clampings; None for one indentation."""
    clampings = means(points)
    if len(clampings) < 2:
        return None
    # `statistics.linear_regression` needs Python 3.10.
    middle = statistics.fmean(a for a, _, _ in clampings)
    rise = math.fsum((a - middle) * d for a, d, _ in clampings)
    slope = rise / math.fsum((a - middle) ** 2 for a, _, _ in clampings)
    return Line(slope, statistics.fmean(d for _, d, _ in clampings) - slope * middle)


def as_svg(points, title):
    """The figure as SVG, by hand."""
    width, height, left, top, right, bottom = 720, 480, 80, 60, 20, 60
    every = [point for some in points.values() for point in some]
    least_a, most_a = min(a for a, _ in every), max(a for a, _ in every)
    edges = [d + sign * sd for some in points.values() for _, d, sd in means(some) for sign in (-1, 1)]
    least_d, most_d = min([0, *edges, *(d for _, d in every)]), max([0, *edges, *(d for _, d in every)])
    margin_a, margin_d = 0.05 * (most_a - least_a or 1), 0.05 * (most_d - least_d or 1)
    least_a, most_a, least_d, most_d = least_a - margin_a, most_a + margin_a, least_d - margin_d, most_d + margin_d

    def x(a):
        return left + (a - least_a) / (most_a - least_a) * (width - left - right)

    def y(d):
        return height - bottom - (d - least_d) / (most_d - least_d) * (height - top - bottom)

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="15">',
        f"<title>{html.escape(title)}</title>",
        f'<rect width="{width}" height="{height}" fill="#fff"/><text x="{left}" y="26">{html.escape(title)}</text>',
        f'<path d="M{left} {top}V{height - bottom}H{width - right}" fill="none" stroke="#333"/>',
        f'<text x="{(left + width) / 2}" y="{height - 14}" text-anchor="middle">indentation a / mm</text>',
        f'<text transform="translate(20 {(top + height - bottom) / 2}) rotate(-90)" text-anchor="middle">displacement / mm</text>',
    ]
    for index in range(5):
        a, d = (low + (high - low) * index / 4 for low, high in ((least_a, most_a), (least_d, most_d)))
        out.append(f'<text x="{x(a):.1f}" y="{height - bottom + 20}" text-anchor="middle">{a:.2f}</text>')
        out.append(f'<text x="{left - 8}" y="{y(d) + 5:.1f}" text-anchor="end">{d:.1f}</text>')
    for place, (walls, some) in enumerate(sorted(points.items())):
        colour = COLOURS[walls]
        out.append(f'<text x="{left + 160 * place}" y="48" fill="{colour}">{walls}, n = {len(some)}</text>')
        fit = line(some)
        if fit:
            ends = [min(a for a, _ in some), max(a for a, _ in some)]
            path = " L".join(f"{x(a):.1f} {y(fit.intercept + fit.slope * a):.1f}" for a in ends)
            out.append(f'<path d="M{path}" stroke="{colour}"/>')
        for a, mean, sd in means(some):
            out.append(f'<path d="M{x(a):.1f} {y(mean - sd):.1f}V{y(mean + sd):.1f}" stroke="{colour}" stroke-width="2"/>')
            out.append(f'<path d="M{x(a) - 8:.1f} {y(mean):.1f}h16" stroke="{colour}" stroke-width="2"/>')
        out += [f'<circle cx="{x(a):.1f}" cy="{y(d):.1f}" r="3.5" fill="{colour}"/>' for a, d in some]
    return "\n".join([*out, "</svg>", ""])


def with_matplotlib(points, title, out):
    """The same with matplotlib, for its other formats."""
    from matplotlib import pyplot

    for walls, some in sorted(points.items()):
        colour = COLOURS[walls]
        pyplot.scatter(*zip(*some), s=12, color=colour, label=f"{walls}, n = {len(some)}")
        a, mean, sd = zip(*means(some))
        pyplot.errorbar(a, mean, yerr=sd, fmt="_", capsize=4, color=colour)
        fit = line(some)
        if fit:
            ends = [min(a), max(a)]
            pyplot.plot(ends, [fit.intercept + fit.slope * end for end in ends], color=colour, linewidth=1)
    pyplot.xlabel("indentation a / mm")
    pyplot.ylabel("displacement / mm")
    pyplot.title(title, fontsize="medium")
    pyplot.legend()
    pyplot.savefig(out)


def main(folder, out="figure7.svg"):
    if not pathlib.Path(folder, "order.csv").is_file():
        sys.exit(f"{folder}: no campaign is here")
    campaign = Campaign(folder)
    left_out = campaign.changed_trials()
    for trial, names in left_out.items():
        print(f"trial {trial} is left out: not as it was written: {', '.join(names)}", file=sys.stderr)
    of_trials = {name for names in left_out.values() for name in names}
    others = [name for name in campaign.changed() if name not in of_trials]
    if others:
        print(f"not as it was written: {', '.join(others)}", file=sys.stderr)
    points = series(campaign)
    if not points:
        sys.exit(f"{folder}: no trial of the series counts yet")
    title = f"Displacement over indentation, origin: {campaign.origin}"
    if campaign.origin != "board":
        title += ", not a measurement"
    if pathlib.Path(out).suffix == ".svg":
        pathlib.Path(out).write_text(as_svg(points, title), encoding="utf-8")
    else:
        with_matplotlib(points, title, out)
    for walls, some in sorted(points.items()):
        fit = line(some)
        slope = f", slope {fit.slope:.4f}, {fit.intercept:.4f} mm at a = 0" if fit else ""
        print(f"{walls}: n = {len(some)}{slope}")
    print(out)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit("which campaign? python3 figure7.py DIR [FILE.svg]")
    main(*sys.argv[1:])
