"""The strategies that every test may run: those that need neither weights nor the deep-learning stack."""

from slimsfm.localization import STRATEGIES

CLASSICAL = sorted(set(STRATEGIES) - {"onepose", "onepose++"})
