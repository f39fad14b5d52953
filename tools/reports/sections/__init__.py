"""The sections of the page in their order. Each module has NAME (of its template, too), TITLE and either `build(run)`, drawn
for each run, or `compare(runs)`, drawn once for all; they give the template's context or raise Missing with the reason."""
from . import again, breaths, cite, eit, effects, energy, facts, fit, loops, numbers, regions, scene, sensitivities, slices, surface, waveforms

ALL = [scene, numbers, waveforms, loops, breaths, fit, sensitivities, slices, regions, eit, surface, effects, energy, facts, again, cite]
