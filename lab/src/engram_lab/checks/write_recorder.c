/* Records what a process does to the files below a folder, for checks.power_cuts.
 *
 *     LD_PRELOAD=write_recorder.so RECORDED_FOLDER=/tmp/map RECORDED_LOG=/tmp/log python …
 *
 * Each record: kind, file, offset, length, bytes of path and of data (six int64), path, data. A file
 * is a number, given when it is created; RENAME and LINK have a second path as their data.
 */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { CREATE = 1, WRITE, TRUNCATE, SYNC, SYNC_FOLDER, RENAME, LINK, UNLINK };
enum { MOST_FDS = 65536, MOST_FILES = 65536 };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static const char *folder;
static int log_fd = -1;
static int64_t file_of[MOST_FDS]; /* 0: not recorded; -1: a folder */
static char *folder_of[MOST_FDS];
static struct { dev_t device; ino_t inode; } files[MOST_FILES];
static int64_t file_count = 1;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) static void start(void) {
  const char *log = getenv("RECORDED_LOG");
  folder = getenv("RECORDED_FOLDER");
  if (folder && log) log_fd = REAL(open)(log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
}

static void record(int64_t kind, int64_t file, int64_t offset, int64_t length, const char *path,
                   const void *data, int64_t size) {
  int64_t head[6] = {kind, file, offset, length, path ? (int64_t)strlen(path) : 0, size};
  struct iovec parts[3] = {
      {head, sizeof head}, {(void *)path, (size_t)head[4]}, {(void *)data, (size_t)size}};
  ssize_t wanted = (ssize_t)(sizeof head) + head[4] + size;
  if (writev(log_fd, parts, 3) != wanted) abort();
}

static int below(const char *path) {
  size_t length = log_fd < 0 ? 0 : strlen(folder);
  return length && path && strncmp(path, folder, length) == 0 &&
         (path[length] == '/' || path[length] == '\0');
}

/* Its number; a new one if `created`, since inodes are used again. */
static int64_t number_of(int fd, int created) {
  struct stat found;
  if (fstat(fd, &found)) abort();
  for (int64_t one = file_count - 1; !created && one > 0; one--)
    if (files[one].inode == found.st_ino && files[one].device == found.st_dev) return one;
  if (file_count == MOST_FILES) abort();
  files[file_count].inode = found.st_ino;
  files[file_count].device = found.st_dev;
  return file_count++;
}

static int opened(int fd, const char *path, int flags, int existed) {
  if (fd < 0 || fd >= MOST_FDS || !below(path)) return fd;
  int kept = errno;
  struct stat found;
  if (fstat(fd, &found)) abort();
  pthread_mutex_lock(&lock);
  if (S_ISDIR(found.st_mode)) {
    file_of[fd] = -1;
    folder_of[fd] = strdup(path);
  } else {
    file_of[fd] = number_of(fd, !existed);
    if (!existed) record(CREATE, file_of[fd], 0, 0, path, NULL, 0);
    else if (flags & O_TRUNC) record(TRUNCATE, file_of[fd], 0, 0, NULL, NULL, 0);
  }
  pthread_mutex_unlock(&lock);
  errno = kept;
  return fd;
}

#define OPENS(name)                                                           \
  int name(const char *path, int flags, ...) {                                \
    va_list rest;                                                             \
    va_start(rest, flags);                                                    \
    mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;                 \
    va_end(rest);                                                             \
    int existed = !below(path) || access(path, F_OK) == 0;                    \
    return opened(REAL(name)(path, flags, mode), path, flags, existed);       \
  }
OPENS(open)
OPENS(open64)

static void wrote(int fd, const void *data, ssize_t size, int64_t offset) {
  if (size > 0 && fd >= 0 && fd < MOST_FDS && file_of[fd] > 0) {
    pthread_mutex_lock(&lock);
    record(WRITE, file_of[fd], offset, size, NULL, data, size);
    pthread_mutex_unlock(&lock);
  }
}

ssize_t write(int fd, const void *data, size_t size) {
  ssize_t done = REAL(write)(fd, data, size);
  if (done > 0 && fd >= 0 && fd < MOST_FDS && file_of[fd] > 0)
    wrote(fd, data, done, lseek(fd, 0, SEEK_CUR) - done);
  return done;
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t offset) {
  ssize_t done = REAL(pwrite)(fd, data, size, offset);
  wrote(fd, data, done, offset);
  return done;
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t offset) {
  ssize_t done = REAL(pwrite64)(fd, data, size, offset);
  wrote(fd, data, done, offset);
  return done;
}

static int on_file(int result, int kind, int fd, int64_t length) {
  if (result == 0 && fd >= 0 && fd < MOST_FDS && file_of[fd]) {
    pthread_mutex_lock(&lock);
    if (file_of[fd] > 0) record(kind, file_of[fd], 0, length, NULL, NULL, 0);
    else record(SYNC_FOLDER, 0, 0, 0, folder_of[fd], NULL, 0);
    pthread_mutex_unlock(&lock);
  }
  return result;
}

int ftruncate(int fd, off_t length) {
  return on_file(REAL(ftruncate)(fd, length), TRUNCATE, fd, length);
}
int ftruncate64(int fd, off64_t length) {
  return on_file(REAL(ftruncate64)(fd, length), TRUNCATE, fd, length);
}
int fsync(int fd) { return on_file(REAL(fsync)(fd), SYNC, fd, 0); }
int fdatasync(int fd) { return on_file(REAL(fdatasync)(fd), SYNC, fd, 0); }

static int named(int result, int kind, const char *path, const char *other) {
  if (result == 0 && below(path)) {
    int kept = errno;
    pthread_mutex_lock(&lock);
    record(kind, 0, 0, 0, path, other, other ? (int64_t)strlen(other) : 0);
    pthread_mutex_unlock(&lock);
    errno = kept;
  }
  return result;
}

int rename(const char *from, const char *to) {
  return named(REAL(rename)(from, to), RENAME, from, to);
}
int link(const char *from, const char *to) { return named(REAL(link)(from, to), LINK, from, to); }
int unlink(const char *path) { return named(REAL(unlink)(path), UNLINK, path, NULL); }

int close(int fd) {
  if (fd >= 0 && fd < MOST_FDS && file_of[fd]) {
    pthread_mutex_lock(&lock);
    if (folder_of[fd]) free(folder_of[fd]);
    folder_of[fd] = NULL;
    file_of[fd] = 0;
    pthread_mutex_unlock(&lock);
  }
  return REAL(close)(fd);
}
