// Threads that take jobs beside the caller, for attempts that a frame makes side by side.
#pragma once

#include <cstddef>
#include <functional>
#include <vector>

#include <sys/types.h>

namespace engram {

class WorkThreads {
public:
  using Job = std::function<void()>; // must not throw

  // `others` threads beside the caller's, started with the first call that has work for them.
  explicit WorkThreads(int others);
  ~WorkThreads();
  WorkThreads(const WorkThreads &) = delete;
  WorkThreads &operator=(const WorkThreads &) = delete;

  // Runs all jobs, the first one on the caller's thread; returns once all are done.
  void run(const std::vector<Job> &jobs);

private:
  struct Shared;
  bool forked() const;

  const size_t others_;
  pid_t process_ = 0; // whose threads they are: a fork has none of them
  Shared *shared_;
};

} // namespace engram
