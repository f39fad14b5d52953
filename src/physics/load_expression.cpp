#include "pulmo/physics/load_expression.hpp"

#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

namespace pulmo {

PetscReal end_of_settling(const SceneFacts &facts)
{
  if (!facts.ventilator) return 0;
  const Phase &first = facts.ventilator->phases().front();
  return first.name == "settle" && first.breath == 0 ? first.end : 0;
}

bool LoadExpression::constant() const
{
  return std::all_of(values.begin(), values.end(), [](const Expression &e) { return e.constant(); });
}

bool LoadExpression::of_place() const
{
  return std::any_of(values.begin(), values.end(), [](const Expression &e) { return e.of_place(); });
}

void LoadExpression::at(PetscReal t, const PetscReal x[3], PetscScalar value[]) const
{
  const PetscReal since = std::max<PetscReal>(0, facts ? t - end_of_settling(*facts) : t);
  for (std::size_t d = 0; d < values.size(); ++d) {
    value[d] = values[d].at(since, x);
    if ((!std::isfinite(value[d]) || !range.holds(value[d])) && !fault_)
      fault_ = Fault{d, value[d], since, {x[0], x[1], x[2]}};
  }
}

void announce_courses(const LoadExpression &load, SceneFacts &facts)
{
  for (std::size_t d = 0; !load.constant() && d < load.values.size(); ++d)
    facts.courses.push_back([&load, d](PetscReal t) {
      constexpr PetscReal somewhere[3] = {1, 2, 3};
      std::vector<PetscScalar> values(load.values.size());
      load.at(t, somewhere, values.data());
      return values[d];
    });
}

PetscErrorCode find_fault(MPI_Comm comm, const std::vector<const LoadExpression *> &loads, std::string &text)
{
  PetscMPIInt rank, ranks, first;
  std::ostringstream words;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &ranks));
  for (const LoadExpression *load : loads) {
    if (!load->fault()) continue;
    const LoadExpression::Fault &f = *load->fault();
    words << load->option;
    if (load->values.size() > 1)
      words << " (component "
            << "xyz"[f.component] << ")";
    words << " is ";
    if (std::isnan(f.value))
      words << "not a number";
    else
      words << f.value;
    words << " at t = " << f.t << " s";
    if (load->values[f.component].of_place()) words << ", (" << f.x[0] << ", " << f.x[1] << ", " << f.x[2] << ") mm";
    if (std::isfinite(f.value))
      words << "; it must be " << load->range.text();
    else
      words << "; an expression must have a finite value wherever and whenever it is used";
    break;
  }
  first = words.str().empty() ? ranks : rank;
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &first, 1, MPI_INT, MPI_MIN, comm));
  text.clear();
  if (first == ranks) PetscFunctionReturn(PETSC_SUCCESS);
  text = words.str();
  std::uint64_t n = text.size();
  PetscCallMPI(MPI_Bcast(&n, 1, MPI_UINT64_T, first, comm));
  text.resize(n);
  PetscCallMPI(MPI_Bcast(text.data(), static_cast<PetscMPIInt>(n), MPI_CHAR, first, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode check_start(const Mesh &mesh, const std::string &surface, const LoadExpression &load)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)mesh.dm());
  std::string why;
  std::vector<PetscScalar> value(load.values.size());

  PetscFunctionBeginUser;
  if (load.constant()) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(mesh.visit_surface(surface, [&](const PetscReal x[3]) { load.at(0, x, value.data()); }));
  PetscCall(find_fault(comm, {&load}, why));
  PulmoUserCheck(why.empty(), comm, "%s", why.c_str());
  PetscFunctionReturn(PETSC_SUCCESS);
}

std::vector<std::unique_ptr<Partner>> LoadWatch::over(const char *name, MPI_Comm comm,
                                                      std::vector<const LoadExpression *> loads)
{
  std::vector<std::unique_ptr<Partner>> list;
  loads.erase(std::remove_if(loads.begin(), loads.end(), [](const LoadExpression *l) { return l->constant(); }),
              loads.end());
  for (const LoadExpression *load : loads) load->forget_fault();
  if (!loads.empty()) list.push_back(std::make_unique<LoadWatch>(name, comm, std::move(loads)));
  return list;
}

} // namespace pulmo
