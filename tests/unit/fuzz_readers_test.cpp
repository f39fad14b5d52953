// Readers of files under mutated input: each file is taken or refused in a sentence; none crashes, hangs or ends in a
// stack trace of PETSc's. PULMO_FUZZ=N mutates N times as many files (for the sanitizers).
#include "support/scene.hpp"

#include "pulmo/input/command_line.hpp"
#include "pulmo/input/programme.hpp"
#include "pulmo/mesh/msh.hpp"
#include "pulmo/mesh/saved_mesh.hpp"

#include <algorithm>
#include <cctype>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <map>
#include <random>
#include <sstream>
#include <unistd.h>

namespace pulmo::test {
namespace {

int rounds(int usual)
{
  const char *times = std::getenv("PULMO_FUZZ");
  return usual * (times ? std::max(1, std::atoi(times)) : 1);
}

std::string content_of(const std::string &file)
{
  std::ifstream in(file, std::ios::binary);
  std::ostringstream content;
  content << in.rdbuf();
  EXPECT_TRUE(in.good()) << file;
  return content.str();
}

/// A file that goes away with the test.
class Scratch {
public:
  explicit Scratch(const std::string &extension)
      : path_(
            (std::filesystem::temp_directory_path() / ("pulmo_fuzz_" + std::to_string(getpid()) + extension)).string())
  {}
  ~Scratch() { std::remove(path_.c_str()); }
  const std::string &write(const std::string &content) const
  {
    std::ofstream(path_, std::ios::binary) << content;
    return path_;
  }

private:
  std::string path_;
};

/// Changes a text in one to four places.
class Mutation {
public:
  explicit Mutation(unsigned seed) : random_(seed) {}

  std::string of(std::string text)
  {
    for (unsigned n = 1 + random_() % 4; n > 0 && !text.empty(); --n) change(text);
    return text;
  }

private:
  std::size_t below(std::size_t n) { return random_() % n; }

  void change(std::string &text)
  {
    static const char *const numbers[] = {
        "0",   "-1",  "1", "2147483647", "-2147483648", "4294967296", "44", "1e308", "-1e-308", "9223372036854775808",
        "nan", "inf", "3", "0x10",       "1e400",       "100000",     "",   "15"};
    const std::size_t at = below(text.size());
    std::size_t from, to;
    switch (below(8)) {
    case 0: // a bit
      text[at] = static_cast<char>(text[at] ^ (1 << below(8)));
      break;
    case 1: // a byte
      text[at] = static_cast<char>(below(256));
      break;
    case 2: // the end
      text.resize(at);
      break;
    case 3: // a word for a number
      word(text, at, from, to);
      text.replace(from, to - from, numbers[below(std::size(numbers))]);
      break;
    case 4: // a word twice
      word(text, at, from, to);
      text.insert(from, text.substr(from, to - from) + (below(2) ? " " : "\n"));
      break;
    case 5: // a word less
      word(text, at, from, to);
      text.erase(from, to - from + (to < text.size()));
      break;
    case 6: { // a piece moved or repeated
      const std::string piece = text.substr(at, 1 + below(60));
      if (below(2)) text.erase(at, piece.size());
      text.insert(below(text.size() + 1), piece);
      break;
    }
    default: // another number of the same file
      word(text, at, from, to);
      std::size_t other_from, other_to;
      word(text, below(text.size()), other_from, other_to);
      text.replace(from, to - from, text.substr(other_from, other_to - other_from));
    }
  }

  static void word(const std::string &text, std::size_t at, std::size_t &from, std::size_t &to)
  {
    const auto is_space = [&](std::size_t i) { return text[i] == ' ' || text[i] == '\n'; };
    for (from = at; from > 0 && !is_space(from - 1);) --from;
    for (to = at; to < text.size() && !is_space(to);) ++to;
  }

  std::mt19937 random_;
};

/// Runs a reader; whether it took its input. Anything but a user error in one sentence fails the test.
template <class Read>
bool taken(Read read, const std::string &input)
{
  ::testing::internal::CaptureStderr();
  const auto code = static_cast<int>(read());
  std::fflush(stderr);
  const std::string said = ::testing::internal::GetCapturedStderr();
  EXPECT_TRUE(code == 0 || code == static_cast<int>(PETSC_ERR_USER_INPUT)) << "code " << code << " for\n" << input;
  EXPECT_EQ(said.find("PETSC ERROR"), std::string::npos) << said << "for\n" << input;
  if (code != 0) {
    EXPECT_EQ(said.rfind("pulmo: error: ", 0), 0u) << said;
    EXPECT_EQ(said.find('\n'), said.size() - 1) << said;
  }
  return code == 0;
}

TEST(Fuzz, Programmes)
{
  const std::string seed = "# a comment\nsettle 1 pressure 5 ramp 0.5\n\nrepeat 2   # breaths\n"
                           "  inspiration 0.8 flow 200 from 800 ramp 0.8 limit 25\n  pause 0.2 hold dt 0.1\n"
                           "  repeat 3\n    expiration 0.5 pressure 5\n  end\nend\nsigh 2 pressure 30 ramp 1 breath\n";
  Mutation mutation(1);
  int read = 0;
  const int n = rounds(2000);
  for (int i = 0; i < n; ++i) {
    const std::string text = mutation.of(seed);
    std::vector<Phase> phases;
    if (!taken([&] { return parse_programme(PETSC_COMM_WORLD, "file", text, phases); }, text)) continue;
    ++read;
    double t = 0;
    for (const Phase &phase : phases) {
      ASSERT_EQ(phase.begin, t) << text;
      ASSERT_GT(phase.end, t) << text;
      ASSERT_TRUE(std::isfinite(phase.to) && std::isfinite(phase.end)) << text;
      ASSERT_LE(phase.ramp, phase.end - phase.begin + 1e-6) << text;
      t = phase.end;
    }
  }
  EXPECT_GT(read, n / 50);
  EXPECT_LT(read, n - n / 50);
}

TEST(Fuzz, ManyRepeatsWithinOneAnother)
{
  std::string text;
  for (int i = 0; i < 20000; ++i) text += "repeat 1\n";
  text += "a 1 hold\n";
  for (int i = 0; i < 20000; ++i) text += "end\n";
  std::vector<Phase> phases;
  EXPECT_FALSE(taken([&] { return parse_programme(PETSC_COMM_WORLD, "file", text, phases); }, "20000 repeats"));
}

constexpr const char *flavours[] = {"22_ascii", "22_binary", "41_ascii", "41_binary"};

/// What is wrong with the bytes of an MSH file; empty if nothing is.
std::string fault_of(const std::string &content)
{
  MeshFile file;
  NamedMesh mesh;
  const std::string fault = read_msh(content, file);
  return fault.empty() ? make_named_mesh(file, {}, 1, mesh) : fault;
}

/// Reads a mesh file as a scene does, and all that is asked of its labels.
PetscErrorCode read_mesh(const std::string &file)
{
  Mesh mesh;
  Options options(PETSC_COMM_WORLD);
  std::vector<Mesh::Region> regions;
  std::vector<Mesh::Pin> pins;
  std::vector<Mesh::Body> bodies;

  PetscFunctionBeginUser;
  PetscCall(set_options("-dm_plex_filename " + file));
  PetscCall(mesh.declare(options));
  PetscCall(mesh.read(options, true));
  PetscCall(mesh.require_surfaces({"airway", "pleura"}, "-some_surfaces"));
  PetscCall(mesh.require_in_each_body({"airway"}, "has no airway"));
  PetscCall(mesh.regions(regions));
  PetscCall(mesh.bodies(bodies));
  for (const Mesh::Body &body : bodies) PetscCall(mesh.rigid_pins(body, pins));
  PetscFunctionReturn(PETSC_SUCCESS);
}

TEST(Fuzz, Meshes)
{
  const Scratch scratch(".msh");
  int sound = 0, read = 0;
  const int n = rounds(1500);
  for (unsigned flavour = 0; flavour < 4; ++flavour) {
    const std::string seed = content_of(source(std::string("meshes/cube_msh") + flavours[flavour] + ".msh"));
    Mutation mutation(flavour + 1);
    for (int i = 0; i < n; ++i) {
      const std::string text = mutation.of(seed);
      const std::string fault = fault_of(text);
      if (!fault.empty() && i % 50 != 0) continue; // refused without a look of PETSc's
      sound += fault.empty();
      read += taken([&] { return read_mesh(scratch.write(text)); }, text);
    }
  }
  EXPECT_GT(sound, n / 50);
  EXPECT_GT(read, n / 50);
}

TEST(Fuzz, MeshesCutAnywhere)
{
  for (const char *flavour : flavours) {
    const std::string whole = content_of(source(std::string("meshes/cube_msh") + flavour + ".msh"));
    ASSERT_EQ(fault_of(whole), "");
    const std::size_t end = whole.find("$EndElements") + std::string("$EndElements").size();
    for (std::size_t length = 0; length < end; ++length)
      ASSERT_NE(fault_of(whole.substr(0, length)), "") << flavour << " cut to " << length << " bytes";
    EXPECT_EQ(fault_of(whole.substr(0, end)), "");
  }
}

TEST(Fuzz, MeshesOfRandomBytes)
{
  std::mt19937 random(5);
  for (int i = rounds(2000); i > 0; --i) {
    std::string text(random() % 3 ? "$MeshFormat\n2.2 1 8\n" : "");
    for (unsigned n = random() % 300; n > 0; --n) text += static_cast<char>(random());
    ASSERT_NE(fault_of(text), "");
  }
}

/// What a saved mesh says, all of it; empty if it is refused.
std::string said_by_saved_mesh(const std::string &file)
{
  SavedMesh mesh;
  SavedMesh::Slice slice;
  std::string fault;
  std::ostringstream text;
  if (!is_saved_mesh(file)) return "";
  EXPECT_EQ(static_cast<int>(read_saved_mesh(PETSC_COMM_SELF, file, mesh, slice, fault)), 0);
  if (!fault.empty()) return "";
  text.precision(17);
  for (const auto &p : mesh.parts)
    text << p.name << ' ' << p.dimension << ' ' << p.elements << ' ' << p.measure << ' ' << p.inside << '\n';
  for (const auto &x : slice.nodes) text << x[0] << ' ' << x[1] << ' ' << x[2] << '\n';
  for (std::size_t c = 0; c < slice.cells.size(); ++c) {
    for (int i = 0; i < 4; ++i) text << slice.cells[c][i] << ' ' << slice.facets[c][i] << ' ';
    text << slice.places[c];
    for (const int part : mesh.volumes[static_cast<std::size_t>(slice.volumes[c])]) text << ' ' << part;
    text << '\n';
  }
  return text.str();
}

/// A byte that changes is found out, or changes nothing: in names (of any encoding), numbers, and what HDF5 says.
TEST(Fuzz, SavedMeshes)
{
  const Scratch scratch(".h5");
  MeshFile file;
  NamedMesh named;
  std::vector<int> order;
  ASSERT_EQ(read_msh(content_of(source("meshes/cube_msh41_binary.msh")), file), "");
  file.groups.front().name = "p\xe9ripherie \xc3\xa9";
  ASSERT_EQ(make_named_mesh(file, {}, 1, named), "");
  for (std::size_t c = named.cells.size(); c > 0; --c) order.push_back(static_cast<int>(c) - 1);
  const std::vector<char> image = image_of(SavedMesh::of(named), named, order);
  const std::string whole(image.begin(), image.end()), said = said_by_saved_mesh(scratch.write(whole));
  ASSERT_NE(said.find(file.groups.front().name), std::string::npos) << said;
  std::mt19937 random(7);
  int refused = 0;
  const int n = rounds(500);
  for (int i = 0; i < n; ++i) {
    std::string text = whole;
    const std::size_t at = random() % text.size();
    text[at] = static_cast<char>(text[at] ^ (1 + random() % 255));
    const std::string now = said_by_saved_mesh(scratch.write(text));
    ASSERT_TRUE(now.empty() || now == said) << "byte " << at;
    refused += now.empty();
  }
  EXPECT_GT(refused, n / 50);
  for (const std::size_t length : {std::size_t(0), std::size_t(20), whole.size() / 2, whole.size() - 1})
    EXPECT_EQ(said_by_saved_mesh(scratch.write(whole.substr(0, length))), "") << length;
}

/// Whatever is taken from option files PETSc takes, too, and the list of options gives it back as it was read.
TEST(Fuzz, OptionFiles)
{
  const Scratch scratch(".opts");
  Mutation mutation(9);
  int passed = 0;
  const int n = rounds(600);
  for (const char *file : {"petsc_options/scenes/pcv.opts", "petsc_options/solvers/iterative.opts"}) {
    const std::string seed =
        content_of(source(file)) +
        "-airflow_surfaces \"airway rim\"\n\talias -short -long_name # new\n-short -7\r-b 'x -y'\n";
    for (int i = 0; i < n; ++i) {
      const std::string text = mutation.of(seed);
      const std::string &path = scratch.write(text);
      const GivenOptions given = read_options({"-options_file", path});
      if (!given.fault.empty()) {
        EXPECT_NE(given.fault.find(path), std::string::npos) << given.fault << "\n" << text;
        continue;
      }
      ++passed;
      std::map<std::string, std::string> last;
      PULMO_OK(PetscOptionsClear(nullptr));
      for (const GivenOption &o : given.list) {
        PULMO_OK(PetscOptionsSetValue(nullptr, o.name.c_str(), o.value.empty() ? nullptr : o.value.c_str()));
        std::string key = o.name;
        std::transform(key.begin(), key.end(), key.begin(),
                       [](unsigned char c) { return c < 128 ? std::tolower(c) : c; });
        last[key] = o.value;
      }
      OptionList list;
      PULMO_OK(Options(PETSC_COMM_WORLD).all_given(list));
      EXPECT_EQ(list.size(), last.size()) << text;
      for (const auto &[name, value] : list) {
        std::string key = name;
        std::transform(key.begin(), key.end(), key.begin(),
                       [](unsigned char c) { return c < 128 ? std::tolower(c) : c; });
        EXPECT_EQ(value, last[key]) << name << " of\n" << text;
      }
      const GivenOptions sent = GivenOptions::unpacked(given.packed());
      ASSERT_EQ(sent.list.size(), given.list.size());
      for (std::size_t k = 0; k < sent.list.size(); ++k) EXPECT_EQ(sent.list[k].value, given.list[k].value);
    }
  }
  PULMO_OK(PetscOptionsClear(nullptr));
  EXPECT_GT(passed, n / 10);
  EXPECT_LT(passed, 2 * n - n / 10);
}

TEST(OptionFiles, LineEndsOfAnySystemAndAByteOrderMark)
{
  const Scratch scratch(".opts");
  for (const std::string end : {"\n", "\r\n", "\r"}) {
    const std::string &path =
        scratch.write("\xEF\xBB\xBF-first 1" + end + "# a comment" + end + "-second 'two words'" + end + end +
                      "-third run#3 # more" + end + "-fourth -2e-3" + end + "-fifth \"-x y\"");
    const GivenOptions given = read_options({"-options_file", path, "-sixth"});
    ASSERT_EQ(given.fault, "");
    ASSERT_EQ(given.list.size(), 6u);
    const std::vector<std::pair<std::string, std::string>> expected{{"-first", "1"},     {"-second", "two words"},
                                                                    {"-third", "run#3"}, {"-fourth", "-2e-3"},
                                                                    {"-fifth", "-x y"},  {"-sixth", ""}};
    for (std::size_t i = 0; i < 6; ++i) {
      EXPECT_EQ(given.list[i].name, expected[i].first);
      EXPECT_EQ(given.list[i].value, expected[i].second);
      EXPECT_EQ(given.list[i].source, i < 5 ? path : "command line");
    }
  }
}

TEST(OptionFiles, ProgrammesHaveTheSameLineEnds)
{
  std::vector<Phase> reference, phases;
  PULMO_OK(parse_programme(PETSC_COMM_WORLD, "file", "# rise\ninspiration 1 pressure 9 ramp 0.1\nrest 2 pressure 1\n",
                           reference));
  for (const char *text : {"\xEF\xBB\xBF# rise\rinspiration 1 pressure 9 ramp 0.1\rrest 2 pressure 1\r",
                           "# rise\r\ninspiration 1 pressure 9 ramp 0.1\r\nrest 2 pressure 1\r\n"}) {
    PULMO_OK(parse_programme(PETSC_COMM_WORLD, "file", text, phases));
    ASSERT_EQ(phases.size(), reference.size()) << text;
    for (std::size_t i = 0; i < phases.size(); ++i) {
      EXPECT_EQ(phases[i].name, reference[i].name);
      EXPECT_EQ(phases[i].end, reference[i].end);
      EXPECT_EQ(phases[i].to, reference[i].to);
    }
  }
  EXPECT_FALSE(taken(
      [&] {
        return parse_programme(PETSC_COMM_WORLD, "file",
                               std::string("\xFF\xFE"
                                           "a\0",
                                           4),
                               phases);
      },
      "UTF-16"));
}

} // namespace
} // namespace pulmo::test
