"""What standing, drivetrain, rolling, grade and turning take of a robot's energy, in words."""

from __future__ import annotations

from tcpipe.report.page import Section
from tcpipe.tables.facts import PhysicsFit, PhysicsTerm

_ASIDE = {"grade": "weight over efficiency"}


def physics_in_words(robot: str, fit: PhysicsFit) -> str:
    """Return the fit as a few sentences: the numbers that a roboticist wants first, each with its standard deviation."""
    grounds = list(dict.fromkeys(of.terrain for of in fit.terms if of.term in {"rolling", "turning"}))
    values = {(of.term, of.terrain): of for of in fit.terms}
    everywhere = [
        f"{_with_std(of)} {of.unit} {_ASIDE.get(of.term, of.term)}"
        for of in fit.terms
        if of.term not in {"rolling", "turning"}
    ]
    said = [", ".join((f"{robot}: {everywhere[0]}", *everywhere[1:]) if everywhere else (f"{robot}",))]
    for ground in grounds:
        parts = []
        if ground in fit.rolling_resistance:
            value, std = fit.rolling_resistance[ground]
            parts.append(f"C_rr {value:.3f} ± {std:.3f}")
        elif (rolling := values.get(("rolling", ground))) is not None:
            parts.append(f"rolling {_with_std(rolling)} N")
        if (turning := values.get(("turning", ground))) is not None:
            parts.append(f"{_with_std(turning)} W per rad/s of turning")
        said.append(f"on {'all ground' if ground == 'all' else ground}: {', '.join(parts)}")
    share = ", ".join(f"{name} {100.0 * part:.0f} %" for name, part in fit.energy_share.items())
    text = f"{'; '.join(said)}. Of all energy: {share} ({fit.segments} segments)."
    if fit.held_out is not None:
        text += f" On held-out fifths it explains {fit.held_out.r2:.2f} of the variance of E (R²), "
        text += f"mean error {100 * fit.held_out.mape:.0f} % where it is 10 J and more"
        if fit.without_turning is not None and fit.gain_of_turning is not None:
            low, high = (round(gain, 2) + 0.0 for gain in fit.gain_of_turning)  # no -0.00
            without = f"{fit.without_turning.r2:.2f} and {100 * fit.without_turning.mape:.0f} %"
            text += f"; without turning {without} (R² by turning {low:+.2f} to {high:+.2f}, 90 %)"
        text += "."
    return text


def _with_std(of: PhysicsTerm) -> str:
    digits = 0 if of.std >= 1.0 else 1
    return f"{of.value:.{digits}f} ± {of.std:.{digits}f}"


def physics_sections(fits: dict[str, PhysicsFit]) -> list[Section]:
    """Return a section of the fits by robot; none where there are none."""
    text = " ".join(physics_in_words(robot, fit) for robot, fit in fits.items())
    return [Section("What a metre costs: standing, drivetrain, rolling, grade, turning", text)] if fits else []
