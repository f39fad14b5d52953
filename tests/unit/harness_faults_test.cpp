// The harness over an effect that is wrong in one way: the check of that finds it, and no other finds anything.
#include "unit/harness.hpp"
#include "unit/harness_faults.hpp"

namespace pulmo::test {
namespace {

/// A fault, the check that has to find it and a part of what it says.
struct Case {
  Fault fault;
  const char *name, *check, *words;
  const char *also = ""; ///< another check that cannot but see it, too

  friend void PrintTo(const Case &c, std::ostream *out) { *out << c.name; }
};

constexpr Case cases[] = {
    {Fault::none, "none", "", ""},
    {Fault::jacobian, "jacobian", "jacobian", "the Jacobian under backward Euler"},
    {Fault::jacobian_shift, "jacobian_shift", "jacobian", "the Jacobian under BDF2"},
    {Fault::pattern, "pattern", "off", "the pattern differs"},
    {Fault::numbers, "numbers", "off", "numbers differ"},
    {Fault::column, "column", "off", "columns of energy.csv"},
    {Fault::callbacks, "callbacks", "off", "callbacks of a residual"},
    {Fault::idle, "idle", "off", "changes nothing"},
    {Fault::energy, "energy", "energy", "does not balance"},
    {Fault::own_cells, "own_cells", "ranks", "on several ranks", "restart"},
    {Fault::counted_twice, "counted_twice", "ranks", "on several ranks", "restart"},
    {Fault::restart, "restart", "restart", "after a restart"},
    {Fault::schemes, "schemes", "schemes", "BDF2 ends at"},
    {Fault::integrators, "integrators", "integrators", "the residual differs", "energy"},
    {Fault::unit, "unit", "help", "-test_bed_stiffness has no unit"},
    {Fault::help, "help", "help", "-test_bed_stiffness says nothing"},
    {Fault::prefix, "prefix", "help", "-bed_depth does not begin with -test_bed"},
    {Fault::ledger, "ledger", "ledger", "as a part of tissue"},
    {Fault::range, "range", "values", "with -test_bed_length 0 the equations are no numbers"},
    {Fault::words, "words", "values", "with -test_bed_factor nan the equations are no numbers"},
};

Registry registry_with(Fault fault)
{
  Registry r = Registry::standard();
  r.effect([=] { return std::make_unique<Bed>(fault); });
  return r;
}

PetscMPIInt ranks()
{
  PetscMPIInt size = 1;
  (void)MPI_Comm_size(PETSC_COMM_WORLD, &size);
  return size;
}

std::string all_of(const Findings &findings)
{
  std::string text;
  for (const std::string &f : findings) text += f + "\n";
  return text;
}

class HarnessFaults : public testing::TestWithParam<Case> {};

TEST_P(HarnessFaults, AreFoundByTheirCheckAlone)
{
  const Case &c = GetParam();
  Findings refused;
  const std::vector<Subject> subjects = alone(registry_with(c.fault), {"test_bed"}, refused);
  ASSERT_EQ(subjects.size(), std::size(all_airways)) << all_of(refused);
  for (const Check &check : checks()) {
    const std::string name = check.name;
    const bool of_ranks = name == "ranks" || name == "restart";
    if (of_ranks ? ranks() == 1 && name == "ranks" : ranks() > 1) continue; // says nothing on one, or on several
    SCOPED_TRACE(name);
    const Findings findings = find(check, subjects.front());
    const std::string text = all_of(findings);
    const bool shows = ranks() > 1 || std::string(c.check) != "ranks";
    if (shows && name == c.check) {
      EXPECT_NE(text.find(c.words), std::string::npos) << "found: " << text;
    } else if (shows && name == c.also) {
      EXPECT_NE(text, "");
    } else {
      EXPECT_EQ(text, "");
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Each, HarnessFaults, testing::ValuesIn(cases),
                         [](const auto &c) { return std::string(c.param.name); });

TEST(HarnessMeetings, AFaultThatShowsBesideAnotherEffectIsFound)
{
  const Registry registry = registry_with(Fault::with_gravity);
  const Check &jacobian = checks().front();
  Findings refused;
  for (const Subject &subject : alone(registry, {"test_bed"}, refused)) EXPECT_EQ(all_of(find(jacobian, subject)), "");
  const auto pair = together(registry, {"test_bed", "gravity"}, refused);
  ASSERT_TRUE(pair);
  EXPECT_NE(all_of(find(jacobian, *pair)), "");
}

} // namespace
} // namespace pulmo::test
