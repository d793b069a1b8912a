"""One profile for all properties: the same examples in every run."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    "pgkit", derandomize=True, deadline=None, database=None, max_examples=40, suppress_health_check=list(HealthCheck)
)
settings.load_profile("pgkit")
