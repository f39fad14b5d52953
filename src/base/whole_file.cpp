#include "pulmo/base/whole_file.hpp"

#include <cerrno>
#include <cstdio>
#include <fcntl.h>
#include <unistd.h>

namespace pulmo {

int write_image(const std::string &file, const std::vector<char> &image, bool sync)
{
  const int descriptor = open(file.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
  if (descriptor < 0) return errno;
  int error = 0;
  for (std::size_t done = 0; error == 0 && done < image.size();) {
    const ssize_t n = ::write(descriptor, image.data() + done, image.size() - done);
    if (n > 0)
      done += static_cast<std::size_t>(n);
    else if (n == 0 || errno != EINTR)
      error = n == 0 ? EIO : errno;
  }
  if (error == 0 && sync && fsync(descriptor) != 0) error = errno;
  if (close(descriptor) != 0 && error == 0) error = errno;
  if (error != 0) (void)unlink(file.c_str());
  return error;
}

int write_whole(const std::string &file, const std::vector<char> &image)
{
  const std::string part = file + ".part";
  const int error = write_image(part, image, false);
  if (error != 0 || std::rename(part.c_str(), file.c_str()) == 0) return error;
  return errno;
}

} // namespace pulmo
