/// @file
/// An effect as it should be, and in each way that the harness knows as it should not be.
#pragma once

#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

#include <cstdlib>

namespace pulmo::test {

/// What its author got wrong.
enum class Fault {
  none,
  jacobian,       ///< a factor
  jacobian_shift, ///< 1 / dt instead of d(rate)/d(value)
  pattern,        ///< it holds the airway while it is off
  numbers,        ///< it pushes a little while it is off
  column,         ///< it has a row in the balance of energy while it is off
  callbacks,      ///< it adds zeros while it is off
  idle,           ///< it does nothing while it is on
  energy,         ///< its work is in no balance
  own_cells,      ///< it counts the cells of one rank
  counted_twice,  ///< it adds up what all ranks have
  restart,        ///< it keeps the past to itself
  schemes,        ///< it makes its own rate, as if two states counted
  integrators,    ///< one callback tells another by a variable of its own
  unit,           ///< an option without a unit
  help,           ///< an option of which -help says nothing
  prefix,         ///< an option under another name
  ledger,         ///< its terms pass for the tissue's
  range,          ///< it divides by what may be zero
  words,          ///< it reads a number by itself
  with_gravity    ///< a wrong Jacobian, but only beside another effect
};

/// Springs and dashpots between each point and where it began: f0 = k u + c u_t, kPa/mm.
struct BedKernels {
  struct Parameters {
    static constexpr const char *owner = "test_bed";
    PetscScalar k = 0.01; ///< kPa/mm^2
    PetscScalar c = 0.01; ///< kPa s/mm^2
    PetscScalar fault = 0;
    PetscScalar began = 0; ///< Fault::restart: where the effect keeps that time

    bool is(Fault f) const { return static_cast<int>(fault) == static_cast<int>(f); }
  };

  static PetscScalar drag(const Point &point, const Parameters &p)
  {
    if (p.is(Fault::schemes) && point.step.multistep != 0) return 1.5 * p.c;
    if (!p.is(Fault::restart)) return p.c;
    auto &began = *constants::to_pointer<PetscScalar *>(p.began);
    if (began < 0) began = point.t - point.step.dt;
    return p.c * (1 + 5 * (point.t - began));
  }
  static void force(const Point &point, const Parameters &p, PetscScalar f0[])
  {
    shared() = point.x[0];
    const PetscScalar c = drag(point, p);
    for (int i = 0; i < 3; ++i) f0[i] += p.k * point.u[i] + c * point.u_t[i];
  }
  static void force_by_displacement(const Point &point, const Parameters &p, PetscScalar g0[])
  {
    const bool wrong = p.is(Fault::jacobian) || p.is(Fault::with_gravity);
    const PetscScalar shift = p.is(Fault::jacobian_shift) ? 1 / point.step.dt : point.shift;
    for (int i = 0; i < 9; i += 4) g0[i] += (wrong ? 1.01 : 1) * (p.k + drag(point, p) * shift);
  }
  /// Fault::integrators: a load that grows along x, which the callback before it has seen.
  static PetscScalar &shared()
  {
    static PetscScalar x = 0;
    return x;
  }
  static void load(const Point &, const Parameters &p, PetscScalar f0[]) { f0[1] += 0.1 * p.k * shared(); }

  static PetscScalar dot(const PetscScalar a[3], const PetscScalar b[3])
  {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  }
  static PetscScalar stored(const Point &now, const Point &before, const Parameters &p)
  {
    return p.k / 2 * (dot(now.u, now.u) - dot(before.u, before.u));
  }
  static PetscScalar numerical(const Point &now, const Point &before, const Parameters &p)
  {
    const PetscScalar du[3] = {now.u[0] - before.u[0], now.u[1] - before.u[1], now.u[2] - before.u[2]};
    return p.k / 2 * dot(du, du);
  }
  static PetscScalar heat(const Point &now, const Point &before, const Parameters &p)
  {
    const PetscScalar du[3] = {now.u[0] - before.u[0], now.u[1] - before.u[1], now.u[2] - before.u[2]};
    return drag(now, p) * dot(now.u_t, du);
  }
  static PetscScalar nothing(const Point &, const Point &, const Parameters &) { return 0; }
};

class Bed final : public Effect {
public:
  explicit Bed(Fault fault) : fault_(fault) {}
  const char *name() const override { return "test_bed"; }
  const char *about() const override { return "springs and dashpots at each point (test)"; }
  bool active() const override
  {
    return on_ || fault_ == Fault::pattern || fault_ == Fault::numbers || fault_ == Fault::column ||
           fault_ == Fault::callbacks;
  }

  PetscErrorCode declare(Options &options) override
  {
    PetscReal length = 1;

    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.flag("", "points are held by springs and dashpots", on_));
    options.group(name(), about(), on_, "-test_bed");
    PetscCall(options.real("stiffness", fault_ == Fault::unit ? "" : "kPa/mm^2", Range::not_negative(),
                           fault_ == Fault::help ? "" : "stiffness of the springs", parameters_.k));
    PetscCall(options.real("drag", "kPa s/mm^2", Range::not_negative(), "drag of the dashpots", parameters_.c));
    if (fault_ == Fault::range) {
      PetscCall(options.real("length", "mm", Range::any(), "length of the springs", length));
      parameters_.k /= length;
    }
    if (fault_ == Fault::words) {
      std::string word = "1";
      PetscCall(options.text("factor", "of the stiffness", word));
      parameters_.k *= std::strtod(word.c_str(), nullptr);
    }
    if (fault_ == Fault::prefix) {
      options.group("bed", about(), on_, "-test_bed");
      PetscCall(options.real("depth", "mm", Range::positive(), "depth of the bed", length));
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &facts) const override
  {
    using K = BedKernels;
    using P = K::Parameters;

    PetscFunctionBeginUser;
    if (fault_ == Fault::idle) PetscFunctionReturn(PETSC_SUCCESS);
    parameters_.fault =
        static_cast<PetscScalar>(fault_ == Fault::with_gravity && !facts.gravity ? Fault::none : fault_);
    parameters_.began = constants::to_scalar(&began_);
    if (!on_ && fault_ == Fault::pattern) {
      Constraint hold;
      hold.name = "airway";
      hold.surface = "airway";
      hold.component[0] = true;
      hold.value = [](PetscReal, const PetscReal[3], PetscScalar u[3]) { u[0] = 0; };
      c.constrain(hold);
      PetscFunctionReturn(PETSC_SUCCESS);
    }
    if (!on_) {
      parameters_.k = fault_ == Fault::numbers ? 1e-9 : 0;
      parameters_.c = 0;
    }
    c.parameters(parameters_);
    if (!on_ && fault_ == Fault::column) {
      c.energy(Energy::dissipated, "test_bed", "", energy_density<P, K::nothing>);
      PetscFunctionReturn(PETSC_SUCCESS);
    }
    PetscCall(count(c));
    if (fault_ == Fault::ledger) c.speaker("tissue");
    c.residual("k u + c u_t", displacement, f0(volume_residual<P, K::force>));
    c.jacobian("bed", displacement, displacement, g0(volume_jacobian<P, K::force_by_displacement>));
    if (fault_ == Fault::integrators) c.residual("load", displacement, f0(volume_residual<P, K::load>));
    if (!on_ || fault_ == Fault::energy) PetscFunctionReturn(PETSC_SUCCESS);
    c.energy(Energy::stored, "elastic_bed", "", energy_density<P, K::stored>);
    c.energy(Energy::numerical, "numerical_dissipation", "", energy_density<P, K::numerical>);
    c.energy(Energy::dissipated, "viscous_bed", "", energy_density<P, K::heat>);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  /// What an author gets wrong who thinks of one rank: the stiffness of all is shared out to the cells.
  PetscErrorCode count(const Composition &c) const
  {
    PetscInt begin, end, own, all;

    PetscFunctionBeginUser;
    PetscCall(DMPlexGetHeightStratum(c.mesh().dm(), 0, &begin, &end));
    own = end - begin;
    PetscCallMPI(
        MPI_Allreduce(&own, &all, 1, MPIU_INT, MPI_SUM, PetscObjectComm(reinterpret_cast<PetscObject>(c.mesh().dm()))));
    if (fault_ == Fault::own_cells) parameters_.k *= static_cast<PetscReal>(own) / static_cast<PetscReal>(all);
    own = 1;
    PetscCallMPI(
        MPI_Allreduce(&own, &all, 1, MPIU_INT, MPI_SUM, PetscObjectComm(reinterpret_cast<PetscObject>(c.mesh().dm()))));
    if (fault_ == Fault::counted_twice) parameters_.k *= static_cast<PetscReal>(all);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  Fault fault_;
  bool on_ = false;
  mutable PetscScalar began_ = -1;
  mutable BedKernels::Parameters parameters_;
};

} // namespace pulmo::test
