// What a user is told of a scene and of a run, beside its numbers.
#include "pulmo/program/notes.hpp"

#include "pulmo/base/units.hpp"
#include "pulmo/fem/free_boundary.hpp"
#include "pulmo/fem/permeability_range.hpp"
#include "pulmo/input/errors.hpp"
#include "pulmo/observers/output.hpp"
#include "pulmo/physics/effects/pressure_damping.hpp"
#include "pulmo/program/prestress_notes.hpp"
#include "pulmo/program/scene_view.hpp"

#include <algorithm>

namespace pulmo {

namespace {

/// Says so before the run if it will have no numbers of a breath.
PetscErrorCode note_no_breath(MPI_Comm comm, const Scene &scene)
{
  PetscFunctionBeginUser;
  if (!scene.facts().ventilator || scene.facts().ventilator->breathes()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(PetscPrintf(comm,
                        "pulmo: note: %s. The numbers of breaths will be null; the static curve has the end of each "
                        "pause (a phase named 'pause', or of 'hold')\n",
                        why_no_numbers(scene, {}).c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Says when the run first left the range of the model: below J = 1 - Phi0 the porosity is negative, and no tissue law
/// but berger keeps J from it.
PetscErrorCode warn_of_no_air(MPI_Comm comm, const Options &options, const Scene &scene, const Simulation &simulation,
                              const RegionAudit &regions)
{
  PetscFunctionBeginUser;
  if (!scene.facts().airflow) PetscFunctionReturn(PETSC_SUCCESS);
  const std::vector<double> porosity = regions.least_porosity(simulation.rows());
  const auto first = std::find_if(porosity.begin(), porosity.end(), [](double least) { return least < 0; });
  if (first == porosity.end()) PetscFunctionReturn(PETSC_SUCCESS);
  std::string given;
  for (const auto &[name, value] : options.own_used())
    if (name == "-tissue_porosity") given = value;
  PetscCall(
      PetscPrintf(comm,
                  "pulmo: warning: at t = %g s the porosity falls below zero: J is less than 1 - Phi0 (least J %g, "
                  "-tissue_porosity %s), so that there would be less than no air; from there on the numbers mean "
                  "nothing. What to try: less suction, -tissue berger, a larger -tissue_porosity\n",
                  (double)simulation.rows()[first - porosity.begin()].time,
                  (double)simulation.rows()[first - porosity.begin()].min_J, given.c_str()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Says where the volume of a ventilated lung is no animal's: a shrew's has 0.05 ml, an elephant's a hundred litres.
PetscErrorCode warn_of_size(MPI_Comm comm, const Scene &scene)
{
  constexpr PetscReal least = 0.02, largest = 2e5; // ml
  const PetscReal volume = scene.mesh().volume() / units::mm3_per_ml;

  PetscFunctionBeginUser;
  if (scene.facts().ventilator && (volume < least || volume > largest))
    PetscCall(
        PetscPrintf(comm,
                    "pulmo: warning: the lung has %.3g ml, %s than any animal's: coordinates times -mesh_scale "
                    "have to be mm; give the -mesh_scale that makes them so (an adult's lung has 2000 to 6000 ml, a "
                    "mouse's 0.2 ml)\n",
                    (double)volume, volume < least ? "less" : "more"));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Pressures and times of a programme that no lung sees, or that its steps do not resolve: told, as each may be meant.
PetscErrorCode note_programme(MPI_Comm comm, const Scene &scene, PetscReal asked_dt)
{
  constexpr PetscReal least = 1, largest = 60, // cmH2O
      shortest = 1e-3,                         // s
      same_time = 1e-6;
  PetscReal low = PETSC_MAX_REAL, high = PETSC_MIN_REAL, extreme = 0; // of breaths; of all
  bool told_short = false, told_step = false, flows = false;

  PetscFunctionBeginUser;
  if (!scene.facts().ventilator) PetscFunctionReturn(PETSC_SUCCESS);
  for (const Phase &phase : scene.facts().ventilator->phases()) {
    const PetscReal duration = phase.end - phase.begin, dt = phase.dt.value_or(asked_dt),
                    part = phase.ramp > 0 ? std::min(phase.ramp, duration) : duration;
    if (phase.control == Control::pressure) {
      for (const PetscReal kPa : {phase.from.value_or(phase.to), phase.to}) {
        const PetscReal P = kPa / units::kPa_per_cmH2O;
        if (phase.breath > 0) {
          low = std::min(low, P);
          high = std::max(high, P);
        }
        if (std::abs(P) > std::abs(extreme)) extreme = P;
      }
    } else {
      flows = flows || phase.to != 0;
    }
    if (!told_short && duration < shortest) {
      told_short = true;
      PetscCall(PetscPrintf(comm,
                            "pulmo: warning: phase '%s' lasts %g s: durations are in seconds, and no breath has a "
                            "phase as short; what comes of it is the numbers' answer to a jump, not a lung's\n",
                            phase.name.c_str(), (double)duration));
    } else if (!told_step && dt > part * (1 + same_time)) {
      told_step = true;
      PetscCall(PetscPrintf(comm,
                            "pulmo: note: a step of %g s is longer than %s of phase '%s' (%g s), which a single step "
                            "takes then: volumes and fits hang on the step; give a smaller -ts_dt, or see how they "
                            "change with it (-error_estimate)\n",
                            (double)dt, phase.ramp > 0 ? "the ramp" : "the whole", phase.name.c_str(), (double)part));
    }
  }
  if (std::abs(extreme) > largest)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: the ventilator gives %.4g cmH2O: a lung sees about %g to %g cmH2O, and "
                          "pressures are in cmH2O (1 cmH2O = 98.07 Pa = 0.09807 kPa); give -ventilator_pip, or the "
                          "programme's pressures, in that unit\n",
                          (double)extreme, (double)least, (double)largest));
  else if (!flows && extreme != 0 && std::abs(extreme) < least)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: the ventilator gives no more than %.4g cmH2O: a lung sees about %g to %g "
                          "cmH2O, and pressures are in cmH2O (0.1 kPa = 1.02 cmH2O); give -ventilator_pip, or the "
                          "programme's pressures, in that unit\n",
                          (double)extreme, (double)least, (double)largest));
  if (!flows && high == low)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: the ventilator's pressure is %.4g cmH2O throughout (-ventilator_pip "
                          "equals -ventilator_peep): no breath\n",
                          (double)high));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Loads that come and go within a step: told, as a step that misses them is as quiet as one that has none.
PetscErrorCode note_load_times(MPI_Comm comm, const Scene &scene, PetscReal dt)
{
  constexpr PetscReal rounding = 1e-6;

  PetscFunctionBeginUser;
  for (const auto &[seconds, of] : scene.facts().load_times)
    if (dt > seconds * (1 + rounding))
      PetscCall(PetscPrintf(comm,
                            "pulmo: note: a step of %g s is longer than the %s (%.3g s), and may miss its height; give "
                            "a smaller -ts_dt\n",
                            (double)dt, of.c_str(), (double)seconds));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Says where springs act on a surface that a support holds, or a wall: what they do moves nothing.
PetscErrorCode note_idle_springs(MPI_Comm comm, const Composition &composition)
{
  const std::vector<std::string> springs = composition.surfaces_of("chest_wall"),
                                 walls = composition.surfaces_of("cavity");

  PetscFunctionBeginUser;
  for (const Constraint &c : composition.constraints()) {
    const bool whole = c.effect == "support" && c.component[0] && c.component[1] && c.component[2];
    if (whole && !c.surface.empty() && std::find(springs.begin(), springs.end(), c.surface) != springs.end())
      PetscCall(PetscPrintf(comm,
                            "pulmo: note: the springs of -chest_wall on surface '%s' do nothing: -support_surfaces "
                            "holds it; leave the surface out of one of the two (-chest_wall_surfaces)\n",
                            c.surface.c_str()));
    if (whole && !c.surface.empty() && std::find(walls.begin(), walls.end(), c.surface) != walls.end())
      PetscCall(PetscPrintf(comm,
                            "pulmo: note: the wall of -cavity on surface '%s' does nothing: -support_surfaces says "
                            "where it goes, and through the wall, too, whatever -cavity_stiffness is; leave the "
                            "surface out of one of the two (-cavity_surfaces)\n",
                            c.surface.c_str()));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Damping is in proportion to h^2 / M with the edge h of a cell and the stiffness M of the tissue; where options make
/// it far larger it is no longer a perturbation of the mesh's own size.
PetscErrorCode check_damping(MPI_Comm comm, const Scene &scene, const Model &model)
{
  constexpr PetscReal told = 10, refused = 1000;

  PetscFunctionBeginUser;
  if (!scene.facts().pressure_damping) PetscFunctionReturn(PETSC_SUCCESS);
  const PetscReal h = scene.mesh().edge(), c = scene.facts().elements.displacement_degree == 1 ? 4 : 6,
                  beta = constants::get<PressureDampingKernels::Parameters>(model.constants_at(0)).beta,
                  share = beta / (h * h / (c * model.modulus()));
  char fix[256];
  PetscCall(PetscSNPrintf(fix, sizeof(fix),
                          "the pressure is damped %.3g times as much as this mesh asks for (cells of %.3g mm, tissue "
                          "of %.3g kPa); leave -pressure_damping_length and -pressure_damping_modulus out, or give "
                          "these values",
                          (double)share, (double)h, (double)model.modulus()));
  PulmoUserCheck(share <= refused, comm, "-pressure_damping: %s", fix);
  if (share > told) PetscCall(PetscPrintf(comm, "pulmo: warning: -pressure_damping: %s: resistance is too low\n", fix));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Where gas crosses a cell in this share of a step the flow is lost in rounding: no tolerance solves the step.
PetscErrorCode check_permeability(MPI_Comm comm, const Scene &scene, const Model &model, PetscReal dt)
{
  constexpr PetscReal most = 1e12;
  const PetscReal L = scene.mesh().length();
  PermeabilityRange k;

  PetscFunctionBeginUser;
  if (!scene.facts().airflow) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(permeability_at_rest(scene.facts(), model, k));
  const PetscReal bound = most * L * L / (model.modulus() * dt);
  PulmoUserCheck(k.largest <= bound, comm,
                 "-airflow_permeability %g mm^2/(kPa s) is so large that the flow is lost in rounding; give less than "
                 "%.1g: far below that there is no resistance left to speak of (or -airflow off)",
                 (double)k.largest, (double)bound);
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A passive lung takes gas in where the pressure rises.
PetscErrorCode warn_of_shrinking(MPI_Comm comm, const Simulation &simulation, const RegionAudit &regions)
{
  const std::vector<SignalRow> rows = regions.complete(simulation.rows());
  const auto found = shrinks_under_pressure(rows);

  PetscFunctionBeginUser;
  if (found)
    PetscCall(PetscPrintf(comm,
                          "pulmo: warning: at t = %g s the lung has %.4g ml less than at the start of the breath, "
                          "though the pressure has risen by %.4g cmH2O: unless a load or a support pushes it, tissue "
                          "or springs are not stable there, and the numbers are no lung's; look at -tissue and its "
                          "parameters\n",
                          rows[*found].time, rows[breath_rows(rows).front().first].volume - rows[*found].volume,
                          rows[*found].machine_pressure() - rows[breath_rows(rows).front().first].machine_pressure()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The same porosity makes a lung without mass; with weight note_weightless() says so.
PetscErrorCode note_massless(MPI_Comm comm, const Scene &scene)
{
  constexpr PetscReal light = 0.9, real = 0.75; // share of air
  const PetscReal porosity = scene.tissue().porosity().reference;

  PetscFunctionBeginUser;
  if (scene.facts().inertia && !scene.facts().gravity && porosity > light)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: with -tissue_porosity %g the lung has hardly any mass, so that -inertia does "
                          "almost nothing; give that of a real one, -tissue_porosity %g\n",
                          (double)porosity, (double)real));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Columns of the signals that rose above what an effect says they should.
PetscErrorCode warn_of_limits(MPI_Comm comm, const Composition &composition, const std::vector<SignalRow> &rows)
{
  PetscFunctionBeginUser;
  for (const SignalLimit &limit : composition.limits()) {
    const SignalSpec &signal = composition.signals()[limit.signal];
    const auto first =
        std::find_if(rows.begin(), rows.end(), [&](const SignalRow &row) { return signal.value(row) > limit.most; });
    if (first != rows.end())
      PetscCall(PetscPrintf(comm, "pulmo: warning: at t = %g s %s is %.3g, and in the run up to %.3g: %s\n",
                            first->time, signal.name.c_str(), signal.value(*first), largest(signal, rows),
                            limit.complaint.c_str()));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode note_weightless(MPI_Comm comm, const Scene &scene, const GravityAudit &gravity)
{
  constexpr double light = 0.1, real = 0.26, tissue = 1.05; // g/ml
  const double volume = scene.mesh().volume() / units::mm3_per_ml;

  PetscFunctionBeginUser;
  if (gravity.weight() < light * volume)
    PetscCall(PetscPrintf(comm,
                          "pulmo: note: with -tissue_porosity %g a lung of %.4g ml weighs %.3g g, so that gravity does "
                          "almost nothing; a real one of that size weighs about %.3g g: give -tissue_porosity %.2f\n",
                          (double)scene.tissue().porosity().reference, volume, gravity.weight(), real * volume,
                          1 - real / tissue));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode warn_of_equal_order(MPI_Comm comm, const Scene &scene, const Model &model, PetscReal dt, bool &warned)
{
  const SceneFacts &facts = scene.facts();
  const Elements &elements = facts.elements;
  const PetscReal half_edge = scene.mesh().edge() / 2;
  PermeabilityRange k;

  PetscFunctionBeginUser;
  if (warned || !facts.airflow || facts.pressure_damping || elements.displacement_degree > elements.pressure_degree)
    PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(permeability_at_rest(scene.facts(), model, k));
  warned = k.least * model.modulus() * dt < half_edge * half_edge;
  if (warned)
    PetscCall(
        PetscPrintf(comm,
                    "pulmo: warning: in a step of %g s pressure spreads by less than half a cell, where "
                    "-elements %s is not stable: look for a pressure that oscillates, or give -pressure_damping\n",
                    (double)dt, elements.name()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode look_ahead(MPI_Comm comm, const Scene &scene, const Model &model, const Simulation &simulation,
                          const std::string &settle_note)
{
  PetscFunctionBeginUser;
  PetscCall(note_free_boundary(model.composition(), scene.facts().airflow));
  PetscCall(warn_of_size(comm, scene));
  PetscCall(warn_of_prestress(comm, scene, model));
  PetscCall(note_idle_springs(comm, model.composition()));
  PetscCall(check_damping(comm, scene, model));
  PetscCall(check_permeability(comm, scene, model, simulation.wanted_dt()));
  PetscCall(warn_beyond_law(comm, scene, model));
  PetscCall(note_massless(comm, scene));
  PetscCall(note_programme(comm, scene, simulation.wanted_dt()));
  PetscCall(note_load_times(comm, scene, simulation.wanted_dt()));
  if (!settle_note.empty()) PetscCall(PetscPrintf(comm, "pulmo: note: %s\n", settle_note.c_str()));
  PetscCall(note_no_breath(comm, scene));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode look_back(MPI_Comm comm, const Options &options, const Scene &scene, const Model &model,
                         const Simulation &simulation, const RegionAudit &regions, bool settles,
                         bool &warned_of_elements)
{
  PetscFunctionBeginUser;
  PetscCall(warn_of_no_air(comm, options, scene, simulation, regions));
  if (!scene.facts().settling.off || !settles) // else loads that act at rest are told already
    PetscCall(warn_of_shrinking(comm, simulation, regions));
  PetscCall(warn_of_limits(comm, model.composition(), simulation.rows()));
  PetscCall(simulation.pins().warn(model));
  for (const SignalRow &row : simulation.rows()) // steps that were cut
    if (row.dt > 0) PetscCall(warn_of_equal_order(comm, scene, model, row.dt, warned_of_elements));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
