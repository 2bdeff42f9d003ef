"""Words of column names in other languages, and how they are called in the patterns that recognise columns."""

from __future__ import annotations

import re
import unicodedata

_WORDS = """
latitude: breite breitengrad latitud
longitude: lange laenge langengrad laengengrad longitud
altitude: hohe hoehe altitud hauteur
speed: geschwindigkeit vitesse velocidad fahrgeschwindigkeit
voltage: spannung tension voltaje batteriespannung
current: strom courant corriente batteriestrom
power: leistung puissance potencia
energy: energie energia
accel: beschleunigung aceleracion
gyro: drehrate kreisel gyroskop gyroscope giroscopio giro winkelgeschwindigkeit drehgeschwindigkeit
battery: akku batterie bateria
battery_voltage: ubat ubatt uakku
battery_current: ibat ibatt iakku
left: links gauche izquierda izq
right: rechts droite derecha der
wheel: roue rueda
motor: moteur
time: zeit uhrzeit zeitstempel temps heure horodatage tiempo hora
date: datum fecha
"""
"""English word, then the same in German, French and Spanish, without accents."""
_ENGLISH = {word: english for english, _, words in (line.partition(": ") for line in _WORDS.strip().splitlines())
            for word in words.split()}  # fmt: skip
_FOREIGN = re.compile(rf"(?<![^\W_])(?:{'|'.join(sorted(_ENGLISH, key=len, reverse=True))})(?![^\W_])", re.IGNORECASE)


def translate(name: str) -> str:
    """Return a column's name without accents and with the words of the table above in English; other words stay as they are."""
    signs = unicodedata.normalize("NFKD", name.replace("µ", "u"))
    plain = "".join(sign for sign in signs if not unicodedata.combining(sign))
    return _FOREIGN.sub(lambda found: _ENGLISH[found[0].lower()], plain)
