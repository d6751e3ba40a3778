"""Strategies that every test can run because they need neither weights nor the deep-learning stack."""

from slimsfm.localization import STRATEGIES

CLASSICAL = sorted(set(STRATEGIES) - {"onepose", "onepose++"})
