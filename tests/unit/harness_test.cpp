// The harness over all that is registered: each effect alone, with each other one, and some three at a time. What only
// an effect knows (a closed form) stands in tests/verification.
#include "unit/harness.hpp"

#include <iostream>

namespace pulmo::test {
namespace {

/// The scenes of the standard registry; those that pulmo refuses are told once.
struct Scenes {
  std::vector<Subject> alone, together;

  Scenes()
  {
    const Registry registry = Registry::standard();
    const std::vector<std::string> names = names_of_effects(registry);
    Findings unmet;
    alone = test::alone(registry, names, refused);
    const auto meet = [&](const std::vector<std::string> &group) {
      if (const auto s = test::together(registry, group, unmet)) together.push_back(*s);
    };
    for (std::size_t i = 0; i < names.size(); ++i)
      for (std::size_t j = 0; j < i; ++j) meet({names[i], names[j]});
    Random random(31);
    for (std::size_t n = 0; n < names.size(); ++n) {
      std::vector<std::string> three;
      while (three.size() < 3) {
        const auto i = static_cast<std::size_t>(random(0, static_cast<double>(names.size()) - 1e-9));
        if (std::find(three.begin(), three.end(), names[i]) == three.end()) three.push_back(names[i]);
      }
      meet(three);
    }
    for (const std::string &text : unmet) {
      std::cout << "refused: " << text;
      if (text.rfind("no sentence", 0) == 0) refused.push_back(text);
    }
  }
  Findings refused; ///< that should not be
};

const Scenes &scenes()
{
  static const Scenes all;
  return all;
}

class Harness : public testing::TestWithParam<Check> {};

TEST_P(Harness, FindsNothing)
{
  const auto look = [](const Subject &subject) {
    SCOPED_TRACE(subject.text());
    for (const std::string &finding : find(GetParam(), subject)) ADD_FAILURE() << finding;
  };
  std::string last;
  for (const Subject &subject : scenes().alone) {
    const bool again = subject.effects.front() == last;
    last = subject.effects.front();
    if (GetParam().pairs || !again) look(subject); // of the others the first airway that takes it
  }
  PetscMPIInt ranks;
  ASSERT_EQ(MPI_Comm_size(PETSC_COMM_WORLD, &ranks), MPI_SUCCESS);
  // what a pair keeps on one rank, and each of it on several, it keeps there, too
  if (GetParam().pairs && (ranks == 1 || std::string(GetParam().name) != "restart"))
    for (const Subject &subject : scenes().together) look(subject);
}

INSTANTIATE_TEST_SUITE_P(Registered, Harness, testing::ValuesIn(checks()),
                         [](const auto &check) { return std::string(check.param.name); });

void check_sweeps(const std::vector<Subject> &subjects)
{
  for (const Subject &subject : subjects) {
    SCOPED_TRACE(subject.text());
    for (const std::string &finding : find({"adjoint", check_adjoint, false}, subject)) ADD_FAILURE() << finding;
  }
}

TEST(HarnessAdjoint, TheSweepIsTheDerivativeWithEachEffect)
{
  check_sweeps(scenes().alone);
}

TEST(HarnessAdjoint, TheSweepIsTheDerivativeWhereEffectsMeet)
{
  check_sweeps(scenes().together);
}

TEST(HarnessScenes, EachEffectIsTakenAndEachRefusalIsASentence)
{
  for (const std::string &text : scenes().refused) ADD_FAILURE() << text;
}

} // namespace
} // namespace pulmo::test
