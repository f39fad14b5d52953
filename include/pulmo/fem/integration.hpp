/// @file
/// pulmo's own PetscFE type: the pointwise callbacks of PetscDS, integrated fast.
///
/// `-petscfe_type pulmo` (the default) differs from PETSc's `basic` only in how it computes: basis functions are
/// tabulated once per scalar node, the kinematic state of a quadrature point is made once for all callbacks, all
/// field pairs are done in one pass, and element matrices are built in blocks of components by one small dense
/// product over all quadrature points. Both give the same numbers (tests/unit, `tools/benchmark assembly`).
///
/// Because all fields are done in one pass, the type works when asked for field 0 and returns at once for the
/// others; PETSc's own loops over fields remain correct.
#pragma once

#include "pulmo/physics/point.hpp"

#include <map>
#include <string>
#include <vector>

namespace pulmo {

/// What the integrator counts. Composed with the PetscDS under the name "pulmo_integration_log".
struct IntegrationLog {
  bool timing = false;          ///< whether the block of cells at hand is timed
  long long residual_calls = 0; ///< volume callbacks called in residuals, over all points
  long long residual_cells = 0; ///< cells in those residuals
  long long jacobian_calls = 0; ///< the same for Jacobians
  long long jacobian_cells = 0;
  long long timed_cells = 0;                ///< cells of the timed blocks, of residuals and Jacobians
  std::map<void (*)(void), double> seconds; ///< of each callback in what was timed: some blocks of cells, all facets

  /// Makes @p log known to the integrator of @p ds.
  static PetscErrorCode attach(PetscDS ds, IntegrationLog *log);
  /// The log of @p ds, or null.
  static PetscErrorCode find(PetscDS ds, IntegrationLog **log);
};

/// What differs between the cells or facets of a call beside the coefficients. Composed with the PetscDS under the name
/// "pulmo_places".
struct PlaceData {
  std::vector<PetscInt> offsets;   ///< which of the constants of PetscDS
  const PetscReal *rows = nullptr; ///< [place of the call][offset]: their values
  Memory memory;                   ///< of the first point of the first place; null where nothing is remembered
  PetscInt memory_width = 0;       ///< scalars of a point; [place][point][width]

  static PetscErrorCode attach(PetscDS ds, PlaceData *places);
  /// Those of @p ds, or null.
  static PetscErrorCode find(PetscDS ds, PlaceData **places);
};

/// Registers the PetscFE type "pulmo".
PetscErrorCode register_fe_type();

} // namespace pulmo
