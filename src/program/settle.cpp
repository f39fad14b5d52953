// What moves the lung before the ventilator does.
#include "pulmo/pulmo.hpp"

#include "pulmo/base/units.hpp"

#include <algorithm>
#include <sstream>

namespace pulmo {

namespace {

/// Rounding may leave as much in the (dimensionless) momentum rows of a lung that nothing loads.
constexpr PetscReal rounding = 1e-12;

/// What loads the undeformed lung while its gas is at atmospheric pressure; empty if nothing does, or no more than
/// @p faint. @p model is not in a run yet.
PetscErrorCode load_at_rest(Model &model, PetscReal faint, std::string &load)
{
  const PetscInt field = displacement;
  VecHandle x, rate, local, global;
  ISHandle rows;
  DMHandle unused;
  Vec momentum;
  PetscReal prescribed, force;

  PetscFunctionBeginUser;
  load.clear();
  PetscCall(DMCreateLocalVector(model.dm(), x.out()));
  PetscCall(VecDuplicate(x, rate.out()));
  PetscCall(VecDuplicate(x, local.out()));
  PetscCall(DMCreateGlobalVector(model.dm(), global.out()));
  PetscCall(VecZeroEntries(x));
  PetscCall(VecZeroEntries(rate));
  PetscCall(model.set_step(1, 0));
  PetscCall(model.constrain(0, x));
  PetscCall(VecNorm(x, NORM_INFINITY, &prescribed)); // of this rank
  PetscCallMPI(
      MPI_Allreduce(MPI_IN_PLACE, &prescribed, 1, MPIU_REAL, MPI_MAX, PetscObjectComm((PetscObject)model.dm())));
  if (prescribed > 0) {
    load = "prescribed displacements";
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscCall(model.residual(0, x, rate, local));
  PetscCall(VecZeroEntries(global));
  PetscCall(DMLocalToGlobal(model.dm(), local, ADD_VALUES, global));
  PetscCall(DMCreateSubDM(model.dm(), 1, &field, rows.out(), unused.out()));
  PetscCall(VecGetSubVector(global, rows, &momentum));
  PetscCall(VecNorm(momentum, NORM_INFINITY, &force));
  PetscCall(VecRestoreSubVector(global, rows, &momentum));
  if (force > faint) load = "forces on the undeformed lung";
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode settle_under_loads(Scene &scene, Model &model, std::string &note)
{
  const Settling &settling = scene.facts().settling;
  std::ostringstream text;
  std::string load;

  PetscFunctionBeginUser;
  note.clear();
  if (!settling.programme && !settling.off) PetscFunctionReturn(PETSC_SUCCESS);
  const auto &prestress = scene.facts().prestress;
  const PetscReal solved =
      prestress && prestress->unloading ? 2 * prestress->unloading->left : 0; // in the run it adds up anew
  PetscCall(load_at_rest(model, std::max(rounding, solved), load));
  if (load.empty() && settling.off && settling.pressure) load = "the pressure at which the programme begins";
  if (load.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  if (settling.off) {
    text << load << ": the lung moves before it breathes, and with -ventilator_settle off that counts as breath";
  } else {
    scene.settle_first();
    text << load << ": the lung moves before it breathes. A phase 'settle' of "
         << scene.facts().ventilator->phases().front().end
         << " s, which is no breath, comes first and all else later (-ventilator_settle)";
  }
  note = text.str();
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
