#include "work_threads.hpp"

#include <algorithm>
#include <condition_variable>
#include <mutex>
#include <thread>

#include <unistd.h>

namespace engram {

struct WorkThreads::Shared {
  std::mutex callers; // one call at a time
  std::mutex mutex;   // of all below
  std::condition_variable begun, done;
  std::vector<std::thread> threads;
  const std::vector<Job> *jobs = nullptr;
  size_t next = 0, pending = 0;
  bool ended = false;

  bool waits() const { return jobs && next < jobs->size(); }

  // Takes jobs until none is left. The lock is held on entry and return, and not while one runs.
  void take(std::unique_lock<std::mutex> &lock) {
    while (waits()) {
      const Job &job = (*jobs)[next++];
      lock.unlock();
      job();
      lock.lock();
      if (--pending == 0)
        done.notify_one();
    }
  }

  void serve() {
    std::unique_lock lock(mutex);
    while (!ended) {
      take(lock);
      begun.wait(lock, [this] { return ended || waits(); });
    }
  }
};

WorkThreads::WorkThreads(int others)
    : others_(static_cast<size_t>(std::max(others, 0))), shared_(new Shared) {}

WorkThreads::~WorkThreads() {
  if (forked())
    return; // what the threads of another process wait for cannot be taken down here
  {
    const std::lock_guard lock(shared_->mutex);
    shared_->ended = true;
  }
  shared_->begun.notify_all();
  for (std::thread &thread : shared_->threads)
    thread.join();
  delete shared_;
}

void WorkThreads::run(const std::vector<Job> &jobs) {
  if (others_ == 0 || jobs.size() < 2 || forked()) {
    for (const Job &job : jobs)
      job();
    return;
  }
  const std::lock_guard caller(shared_->callers);
  process_ = getpid();
  while (shared_->threads.size() < std::min(others_, jobs.size() - 1))
    shared_->threads.emplace_back(&Shared::serve, shared_);
  std::unique_lock lock(shared_->mutex);
  shared_->jobs = &jobs;
  shared_->next = 0;
  shared_->pending = jobs.size();
  shared_->begun.notify_all();
  shared_->take(lock);
  shared_->done.wait(lock, [this] { return shared_->pending == 0; });
  shared_->jobs = nullptr;
}

bool WorkThreads::forked() const { return process_ != 0 && process_ != getpid(); }

} // namespace engram
