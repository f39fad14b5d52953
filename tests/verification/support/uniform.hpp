/// @file
/// A cube whose deformation is uniform and prescribed, and its mean stress by the reactions on its faces.
#pragma once

#include "support/scene.hpp"
#include "verification/support/scene_parts.hpp"

#include <array>
#include <functional>
#include <vector>

namespace pulmo::test {

using Motion = std::function<std::array<double, 9>(double t)>; ///< Grad u

/// Prescribes u = H(t) X on all faces, so that the deformation is uniform.
inline Registry driven(const Motion &motion)
{
  Registry r = Registry::standard();
  for (const char *face : {"x0", "x1", "y0", "y1", "z0", "z1"})
    add_essential(r, displacement, face, [motion](PetscReal t, const PetscReal x[3], PetscScalar v[3]) {
      const auto H = motion(t);
      for (int i = 0; i < 3; ++i) v[i] = H[3 * i] * x[0] + H[3 * i + 1] * x[1] + H[3 * i + 2] * x[2];
    });
  return r;
}

/// Mean stress P at each row of a run, kPa.
struct History {
  std::vector<double> t;
  std::vector<std::array<double, 9>> P;
};

/// First Piola-Kirchhoff stress in the cube: mean over it by the sum of boundary reactions, int P dV = sum of f_i X_J.
class StressObserver final : public Observer {
public:
  StressObserver(Run &run, History &history) : run_(run), history_(history) {}
  PetscErrorCode observe(const StepReport &step) override
  {
    PetscFunctionBeginUser;
    if (step.row.time == 0) PetscFunctionReturn(PETSC_SUCCESS);
    PetscSection section;
    PetscInt begin, end;
    std::array<double, 9> P{};
    std::vector<std::array<PetscReal, 3>> nodes;
    PetscCall(DMGetLocalSection(run_.model().dm(), &section));
    PetscCall(PetscSectionGetChart(section, &begin, &end));
    const ReadArray f(step.residual);
    for (PetscInt p = begin; p < end; ++p) {
      PetscInt n, offset;
      PetscCall(PetscSectionGetFieldDof(section, p, displacement, &n));
      PetscCall(PetscSectionGetFieldOffset(section, p, displacement, &offset));
      if (n == 0) continue;
      PetscCall(node_coordinates(run_.model().dm(), p, n / 3, nodes));
      for (const auto &x : nodes)
        for (int i = 0; i < 3; ++i, ++offset)
          for (int J = 0; J < 3; ++J) P[3 * i + J] += f[offset] / run_.model().row_scale(displacement) * x[J];
    }
    history_.t.push_back(step.row.time);
    history_.P.push_back(P);
    PetscFunctionReturn(PETSC_SUCCESS);
  }

private:
  Run &run_;
  History &history_;
};

} // namespace pulmo::test
