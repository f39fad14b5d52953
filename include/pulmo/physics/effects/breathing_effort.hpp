/// @file
/// Effect `breathing_effort`: the muscles pull the lung open. A suction p_s(t) >= 0 that follows the surface, traction
/// +p_s J F^-T N per reference area, on the pleura by default.
///
/// By Piola's identity the same as a gas pressure p_s in all of the lung and on its airway wall, less p_s in the gas
/// (with -lumen_pressure, and nothing else on the boundary that knows the pressure).
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/input/csv.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"
#include "pulmo/physics/follower_pressure.hpp"
#include "pulmo/physics/load_expression.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

namespace pulmo {

/// The suction over time.
struct EffortCourse {
  PetscReal amplitude = 5, rise = 0.8, hold = 0.1, fall = 0.3, period = 4, delay = 0; ///< cmH2O, s
  std::vector<PetscReal> times, pressures; ///< of a file, s and cmH2O: linear between, repeated; empty: pulses
  bool expressed = false;
  LoadExpression expression; ///< in their place
  const SceneFacts *facts = nullptr;

  /// The clock starts where a phase `settle` at the start of the run ends, s.
  PetscReal start() const { return delay + (facts ? end_of_settling(*facts) : 0); }
  /// The shorter of rise and fall, s; empty for an expression, which does not say.
  std::optional<PetscReal> fastest() const
  {
    if (expressed) return {};
    if (times.empty()) return std::min(rise, fall);
    const auto peak = std::max_element(pressures.begin(), pressures.end()) - pressures.begin();
    return std::min(times[static_cast<std::size_t>(peak)], times.back() - times[static_cast<std::size_t>(peak)]);
  }
  /// cmH2O at time @p t of the run.
  PetscReal at(PetscReal t) const
  {
    const PetscReal since = t - start();
    if (since <= 0) return 0;
    if (expressed) {
      constexpr PetscReal nowhere[3] = {0, 0, 0};
      PetscScalar value;
      expression.at(since, nowhere, &value);
      return value;
    }
    return times.empty() ? pulse(std::fmod(since, period)) : listed(std::fmod(since, times.back()));
  }

private:
  PetscReal pulse(PetscReal s) const
  {
    if (s < rise) return amplitude / 2 * (1 - std::cos(PETSC_PI * s / rise));
    if (s <= rise + hold) return amplitude;
    const PetscReal falling = s - rise - hold;
    return falling < fall ? amplitude / 2 * (1 + std::cos(PETSC_PI * falling / fall)) : 0;
  }
  PetscReal listed(PetscReal s) const
  {
    const auto after = std::upper_bound(times.begin() + 1, times.end() - 1, s);
    const auto i = static_cast<std::size_t>(after - times.begin());
    return pressures[i - 1] + (pressures[i] - pressures[i - 1]) * (s - times[i - 1]) / (times[i] - times[i - 1]);
  }
};

struct BreathingEffortKernels {
  struct Parameters {
    static constexpr const char *owner = "breathing_effort";
    PetscScalar course = 0; ///< const EffortCourse *, as constants::to_scalar() packs it
  };

  static PetscScalar pleural_suction(PetscReal t, const PetscScalar constants[])
  {
    const auto k = constants::get<Parameters>(constants);
    return constants::to_pointer<const EffortCourse *>(k.course)->at(t) * units::kPa_per_cmH2O;
  }
  static PetscScalar suction(const Point &point, const Parameters &k)
  {
    return constants::to_pointer<const EffortCourse *>(k.course)->at(point.t) * units::kPa_per_cmH2O;
  }
  /// f0 = -p_s cof F N.
  static void pull(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    add_follower_pressure(point, -suction(point, k), f0);
  }
  static void pull_by_displacement(const Point &point, const Parameters &k, PetscScalar g1[])
  {
    add_follower_pressure_by_displacement(point, -suction(point, k), g1);
  }
  static PetscScalar work(const Point &now, const Point &before, const Parameters &k)
  {
    return follower_pressure_work(now, before, -suction(now, k));
  }
};

class BreathingEffort final : public Effect {
public:
  const char *name() const override { return "breathing_effort"; }
  const char *about() const override { return "suction by the muscles of breathing, which follows the surface"; }
  const char *absence() const override { return "the muscles of breathing do nothing: a passive patient"; }
  std::string example() const override
  {
    return "-breathing_effort -breathing_effort_pressure 2 -breathing_effort_rise 0.4 -breathing_effort_hold 0.05 "
           "-breathing_effort_fall 0.1 -breathing_effort_period 0.6";
  }
  bool active() const override { return on_; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "the muscles of breathing pull on surfaces", on_));
    options.group(name(), about(), on_, "-breathing_effort");
    PetscCall(options.names("surfaces", "surfaces that they pull on", surfaces_));
    PetscCall(options.text("file",
                           "table (CSV) time_s,pressure_cmH2O, linear between its rows and repeated; instead "
                           "of pulses",
                           file_));
    std::vector<Expression> course(1);
    bool given;
    PetscCall(options.expressions("course", "cmH2O",
                                  "suction as an expression of t (s, from the first effort on); instead of "
                                  "pulses",
                                  course));
    PetscCall(options.given("course", given));
    PetscCall(options.real("delay", "s", Range::not_negative(),
                           "time of rest before the first effort (after a phase 'settle' at the start)",
                           course_.delay));
    course_.expressed = given;
    course_.expression.option = "-breathing_effort_course";
    course_.expression.values = course;
    course_.expression.range = Range::not_negative();
    options.group(name(), "pulses", on_ && file_.empty() && !given,
                  "-breathing_effort without -breathing_effort_file and -breathing_effort_course");
    PetscCall(options.real("pressure", "cmH2O", Range::not_negative(), "suction while it is held", course_.amplitude));
    PetscCall(options.real("rise", "s", Range::positive(), "time of its rise (raised cosine)", course_.rise));
    PetscCall(options.real("hold", "s", Range::not_negative(), "time that it is held", course_.hold));
    PetscCall(options.real("fall", "s", Range::positive(), "time of its fall (raised cosine)", course_.fall));
    PetscCall(options.real("period", "s", Range::positive(), "from one effort to the next", course_.period));
    if (!on_) PetscFunctionReturn(PETSC_SUCCESS);
    comm_ = options.comm();
    PulmoUserCheck(file_.empty() || !given, options.comm(),
                   "-breathing_effort_file and -breathing_effort_course both tell the course of the suction; leave one "
                   "out");
    if (!file_.empty()) PetscCall(read(options));
    if (given) PetscCall(check_course(options.comm()));
    PulmoUserCheck(!file_.empty() || given || course_.rise + course_.hold + course_.fall <= course_.period,
                   options.comm(),
                   "-breathing_effort_period %g s is shorter than rise, hold and fall together, %g s; give a longer "
                   "period",
                   (double)course_.period, (double)(course_.rise + course_.hold + course_.fall));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.pleural_suction = BreathingEffortKernels::pleural_suction;
    facts.courses.push_back([this](PetscReal t) { return course_.at(t); });
    if (const auto time = course_.fastest())
      facts.load_times.push_back({*time, file_.empty() ? "rise or fall of -breathing_effort"
                                                       : "rise or fall of -breathing_effort_file " + file_});
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &facts) override
  {
    std::vector<PetscInt> pulled, open;
    int shared = 0;

    PetscFunctionBeginUser;
    PulmoUserCheck(!surfaces_.empty(), options.comm(), "-breathing_effort needs -breathing_effort_surfaces NAME,...");
    PetscCall(mesh.require_surfaces(surfaces_, "-breathing_effort_surfaces"));
    if (facts.ventilator) {
      const Phase &first = facts.ventilator->phases().front();
      PulmoUserCheck(first.name != "settle" || !first.may_end_early(), options.comm(),
                     "%s: the efforts of -breathing_effort begin when the phase 'settle' at the start of the run ends, "
                     "which must have a time of its own: leave 'trigger' or 'cycle' out of it",
                     first.where.c_str());
    }
    for (const std::string &airway : facts.airway_surfaces) {
      if (mesh.surfaces().count(airway) == 0) continue;
      PetscCall(mesh.facets(airway, open));
      std::sort(open.begin(), open.end());
      for (const std::string &surface : surfaces_) {
        PetscCall(mesh.facets(surface, pulled));
        shared = std::any_of(pulled.begin(), pulled.end(),
                             [&](PetscInt facet) { return std::binary_search(open.begin(), open.end(), facet); });
        PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &shared, 1, MPI_INT, MPI_LOR, options.comm()));
        PulmoUserCheck(!shared, options.comm(),
                       "-breathing_effort_surfaces: surface '%s' has facets of the airway '%s', where no muscle pulls; "
                       "name the surface of the lung without its airway",
                       surface.c_str(), airway.c_str());
      }
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = BreathingEffortKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    course_.facts = &facts;
    parameters_.course = constants::to_scalar(static_cast<const EffortCourse *>(&course_));
    c.parameters(parameters_);
    c.read_in_place(P::owner,
                    {&course_.delay, &course_.amplitude, &course_.rise, &course_.hold, &course_.fall, &course_.period});
    for (const std::string &surface : surfaces_) {
      c.surface_residual("-p_s cof F N . eta", surface, displacement, f0(surface_residual<P, K::pull>));
      c.surface_jacobian("suction", surface, displacement, displacement,
                         g1(surface_jacobian<P, K::pull_by_displacement>));
      c.energy(Energy::external, "muscles", surface, energy_density<P, K::work>);
    }
    c.signal("muscle_pressure_cmH2O", [this](const SignalRow &row) { return course_.at(row.time); });
    c.signal("transrespiratory_pressure_cmH2O",
             [this](const SignalRow &row) { return row.pressure + course_.at(row.time); });
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::vector<std::unique_ptr<Partner>> partners(const SceneFacts &) const override
  {
    if (!course_.expressed) return {};
    return LoadWatch::over(name(), comm_, {&course_.expression});
  }

private:
  PetscErrorCode check_course(MPI_Comm comm) const
  {
    constexpr PetscReal nowhere[3] = {0, 0, 0}, rest = 1e-6; // cmH2O
    const Expression &course = course_.expression.values.front();
    const PetscReal first = course.at(0, nowhere);

    PetscFunctionBeginUser;
    PulmoUserCheck(!course.of_place(), comm,
                   "-breathing_effort_course '%s' depends on x, y or z; the suction is the same all over the surface: "
                   "give an expression of t alone",
                   course.text().c_str());
    PulmoUserCheck(
        std::abs(first) <= rest, comm,
        "-breathing_effort_course '%s' is %.6g cmH2O at t = 0; the effort begins from rest: it must be 0 there",
        course.text().c_str(), (double)first);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode read(Options &options)
  {
    Csv table;

    PetscFunctionBeginUser;
    PetscCall(Csv::read(options.comm(), "-breathing_effort_file", file_, {"time_s", "pressure_cmH2O"}, table));
    options.note_content("-breathing_effort_file", "a table, " + table.hash());
    PulmoUserCheck(table.rows() >= 3, options.comm(),
                   "-breathing_effort_file %s has %d rows; at least three of time_s,pressure_cmH2O are an effort",
                   file_.c_str(), static_cast<int>(table.rows()));
    for (std::size_t i = 0; i < table.rows(); ++i) {
      std::optional<PetscReal> t, p;
      PetscCall(table.number(i, "time_s", Range::not_negative(), t));
      PetscCall(table.number(i, "pressure_cmH2O", Range::not_negative(), p));
      PulmoUserCheck(t && p, options.comm(), "%s: a row needs a number in time_s and one in pressure_cmH2O",
                     table.where(i).c_str());
      PulmoUserCheck(i == 0 ? *t == 0 : *t > course_.times.back(), options.comm(),
                     "%s: time_s must begin with 0 and increase from row to row", table.where(i).c_str());
      course_.times.push_back(*t);
      course_.pressures.push_back(*p);
    }
    PulmoUserCheck(course_.pressures.front() == 0 && course_.pressures.back() == 0, options.comm(),
                   "-breathing_effort_file %s: the first and the last pressure must be 0: the effort begins from rest, "
                   "and is repeated",
                   file_.c_str());
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  bool on_ = false;
  std::vector<std::string> surfaces_{"pleura"};
  std::string file_;
  MPI_Comm comm_ = MPI_COMM_NULL;
  mutable EffortCourse course_;
  mutable BreathingEffortKernels::Parameters parameters_;
};

} // namespace pulmo
