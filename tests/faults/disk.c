/* A disk that fills up, or a process that is killed, at a chosen call: preloaded below Python and all libraries.
 *
 * Calls that change files below a folder are counted over all processes. At the `at`-th, `mode` says what happens.
 * The counters are in a file that each process maps; its name is in MAGTWIN_FAULTS.
 */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OFF, COUNT, FULL, KILL };

struct control { /* as `Disk` in faults.py maps it */
    _Atomic long calls;
    long at;
    long mode;
    _Atomic long full;
    long group; /* process group that a kill ends */
    char folder[1024];
    char trace[1024];
};

static struct control *disk;

__attribute__((constructor)) static void begin(void)
{
    const char *name = getenv("MAGTWIN_FAULTS");
    if (!name)
        return;
    int fd = (int)syscall(SYS_openat, AT_FDCWD, name, O_RDWR | O_CLOEXEC, 0);
    if (fd < 0)
        return;
    void *at = mmap(NULL, sizeof *disk, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    syscall(SYS_close, fd);
    if (at != MAP_FAILED)
        disk = at;
}

static int below(const char *path)
{
    size_t length = strlen(disk->folder);
    return !strncmp(path, disk->folder, length) && (path[length] == '/' || !path[length]);
}

/* The file of a descriptor, "" if it is not one below the folder. */
static const char *of_fd(int fd, char *path)
{
    char link[40];
    if (!disk || disk->mode == OFF)
        return "";
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    long length = syscall(SYS_readlinkat, AT_FDCWD, link, path, 4095);
    path[length > 0 ? length : 0] = 0;
    return below(path) ? path : "";
}

/* The absolute name of a file, "" if it is not below the folder. */
static const char *of_name(int dirfd, const char *name, char *path)
{
    long length = 0;
    if (!disk || disk->mode == OFF || !name)
        return "";
    if (name[0] != '/') {
        char link[40] = "/proc/self/cwd";
        if (dirfd != AT_FDCWD)
            snprintf(link, sizeof link, "/proc/self/fd/%d", dirfd);
        length = syscall(SYS_readlinkat, AT_FDCWD, link, path, 4000);
        if (length < 0)
            return "";
        path[length++] = '/';
        while (name[0] == '.' && name[1] == '/')
            name += 2;
    }
    snprintf(path + length, 4096 - length, "%s", name);
    return below(path) ? path : "";
}

enum { PASS, REFUSE, HALF };

/* What a call needs: it frees room and is never refused; it is refused once; it needs room, which is gone. */
enum { FREES, ONCE, ROOM };

static int event(const char *what, const char *path, const char *other, long size, int needs)
{
    if (!*path)
        return PASS;
    long number = atomic_fetch_add(&disk->calls, 1) + 1;
    if (disk->trace[0]) {
        char line[9000];
        int length = snprintf(line, sizeof line, "%ld\t%s\t%s\t%s\t%ld\n", number, what, path, other, size);
        int fd = (int)syscall(SYS_openat, AT_FDCWD, disk->trace, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644);
        syscall(SYS_write, fd, line, length);
        syscall(SYS_close, fd);
    }
    if (disk->mode == KILL && number == disk->at)
        return HALF;
    if (disk->mode != FULL || needs == FREES)
        return PASS;
    if (number == disk->at) {
        disk->full = 1;
        return size > 1 && number % 2 ? HALF : REFUSE;
    }
    return disk->full && needs == ROOM ? REFUSE : PASS;
}

static void end(void)
{
    kill((pid_t)-disk->group, SIGKILL);
    kill(getpid(), SIGKILL);
    for (;;)
        pause();
}

/* A call that writes nothing: true if it is to fail. */
static int refused(const char *what, const char *path, const char *other, int needs)
{
    int then = event(what, path, other, 0, needs);
    if (then == PASS)
        return 0;
    if (disk->mode == KILL)
        end();
    errno = ENOSPC;
    return 1;
}

/* A call that writes: `half` writes half of it, `whole` all. */
#define WRITES(what, fd, size, half, whole)                                                        \
    do {                                                                                           \
        char path[4096];                                                                           \
        int then = event(what, of_fd(fd, path), "", (long)(size), ROOM);                              \
        if (then == HALF) {                                                                        \
            long done = (size) > 1 ? (half) : 0;                                                   \
            if (disk->mode == KILL)                                                                \
                end();                                                                             \
            return done;                                                                           \
        }                                                                                          \
        if (then == REFUSE) {                                                                      \
            errno = ENOSPC;                                                                        \
            return -1;                                                                             \
        }                                                                                          \
        return whole;                                                                              \
    } while (0)

static long total(const struct iovec *parts, int count)
{
    long sum = 0;
    for (int k = 0; k < count; k++)
        sum += (long)parts[k].iov_len;
    return sum;
}

ssize_t write(int fd, const void *data, size_t size)
{
    WRITES("write", fd, size, syscall(SYS_write, fd, data, size / 2), syscall(SYS_write, fd, data, size));
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at)
{
    WRITES("write", fd, size, syscall(SYS_pwrite64, fd, data, size / 2, at),
           syscall(SYS_pwrite64, fd, data, size, at));
}

ssize_t pwrite(int fd, const void *data, size_t size, off_t at) { return pwrite64(fd, data, size, at); }

ssize_t writev(int fd, const struct iovec *parts, int count)
{
    WRITES("write", fd, total(parts, count), syscall(SYS_write, fd, parts[0].iov_base, parts[0].iov_len / 2),
           syscall(SYS_writev, fd, parts, count));
}

ssize_t pwritev64(int fd, const struct iovec *parts, int count, off64_t at)
{
    WRITES("write", fd, total(parts, count),
           syscall(SYS_pwrite64, fd, parts[0].iov_base, parts[0].iov_len / 2, at),
           syscall(SYS_pwritev, fd, parts, count, (long)at, 0L));
}

ssize_t pwritev(int fd, const struct iovec *parts, int count, off_t at) { return pwritev64(fd, parts, count, at); }

ssize_t sendfile64(int out, int in, off64_t *at, size_t size)
{
    WRITES("write", out, size, syscall(SYS_sendfile, out, in, at, size / 2),
           syscall(SYS_sendfile, out, in, at, size));
}

ssize_t sendfile(int out, int in, off_t *at, size_t size) { return sendfile64(out, in, at, size); }

ssize_t copy_file_range(int in, off64_t *from, int out, off64_t *to, size_t size, unsigned flags)
{
    WRITES("write", out, size, syscall(SYS_copy_file_range, in, from, out, to, size / 2, flags),
           syscall(SYS_copy_file_range, in, from, out, to, size, flags));
}

#define ON_FD(what, fd, needs)                                                                      \
    do {                                                                                           \
        char path[4096];                                                                           \
        if (refused(what, of_fd(fd, path), "", needs))                                              \
            return -1;                                                                             \
    } while (0)

int fsync(int fd)
{
    ON_FD("fsync", fd, ONCE);
    return (int)syscall(SYS_fsync, fd);
}

int fdatasync(int fd)
{
    ON_FD("fsync", fd, ONCE);
    return (int)syscall(SYS_fdatasync, fd);
}

int ftruncate64(int fd, off64_t size)
{
    ON_FD("truncate", fd, ROOM);
    return (int)syscall(SYS_ftruncate, fd, size);
}

int ftruncate(int fd, off_t size) { return ftruncate64(fd, size); }

int fallocate64(int fd, int mode, off64_t at, off64_t size)
{
    ON_FD("allocate", fd, ROOM);
    return (int)syscall(SYS_fallocate, fd, mode, at, size);
}

int fallocate(int fd, int mode, off_t at, off_t size) { return fallocate64(fd, mode, at, size); }

int posix_fallocate64(int fd, off64_t at, off64_t size)
{
    char path[4096];
    if (refused("allocate", of_fd(fd, path), "", ROOM))
        return ENOSPC;
    return syscall(SYS_fallocate, fd, 0, at, size) ? errno : 0;
}

int posix_fallocate(int fd, off_t at, off_t size) { return posix_fallocate64(fd, at, size); }

static int renames(int from_dir, const char *from, int to_dir, const char *to, unsigned flags)
{
    char old[4096], new[4096];
    if (refused("rename", of_name(to_dir, to, new), of_name(from_dir, from, old), ONCE))
        return -1;
    return (int)syscall(SYS_renameat2, from_dir, from, to_dir, to, flags);
}

int rename(const char *from, const char *to) { return renames(AT_FDCWD, from, AT_FDCWD, to, 0); }

int renameat(int from_dir, const char *from, int to_dir, const char *to)
{
    return renames(from_dir, from, to_dir, to, 0);
}

int renameat2(int from_dir, const char *from, int to_dir, const char *to, unsigned flags)
{
    return renames(from_dir, from, to_dir, to, flags);
}

int linkat(int from_dir, const char *from, int to_dir, const char *to, int flags)
{
    char old[4096], new[4096];
    if (refused("link", of_name(to_dir, to, new), of_name(from_dir, from, old), ROOM))
        return -1;
    return (int)syscall(SYS_linkat, from_dir, from, to_dir, to, flags);
}

int link(const char *from, const char *to) { return linkat(AT_FDCWD, from, AT_FDCWD, to, 0); }

int symlinkat(const char *from, int to_dir, const char *to)
{
    char new[4096];
    if (refused("link", of_name(to_dir, to, new), "", ROOM))
        return -1;
    return (int)syscall(SYS_symlinkat, from, to_dir, to);
}

int symlink(const char *from, const char *to) { return symlinkat(from, AT_FDCWD, to); }

int mkdirat(int dir, const char *name, mode_t mode)
{
    char path[4096];
    struct stat about;
    if (syscall(SYS_newfstatat, dir, name, &about, 0) && refused("mkdir", of_name(dir, name, path), "", ROOM))
        return -1;
    return (int)syscall(SYS_mkdirat, dir, name, mode);
}

int mkdir(const char *name, mode_t mode) { return mkdirat(AT_FDCWD, name, mode); }

int unlinkat(int dir, const char *name, int flags)
{
    char path[4096];
    if (refused("remove", of_name(dir, name, path), "", FREES))
        return -1;
    return (int)syscall(SYS_unlinkat, dir, name, flags);
}

int unlink(const char *name) { return unlinkat(AT_FDCWD, name, 0); }

int rmdir(const char *name) { return unlinkat(AT_FDCWD, name, AT_REMOVEDIR); }

int remove(const char *name)
{
    int done = unlinkat(AT_FDCWD, name, 0);
    return done && errno == EISDIR ? unlinkat(AT_FDCWD, name, AT_REMOVEDIR) : done;
}

/* Whether to open a file would make it or empty it, and is to fail. */
static int opens(int dir, const char *name, int flags)
{
    char path[4096];
    struct stat about;
    if (!(flags & O_CREAT) && (flags & O_TMPFILE) != O_TMPFILE)
        return 0;
    if ((flags & O_TMPFILE) != O_TMPFILE && !syscall(SYS_newfstatat, dir, name, &about, 0))
        return 0;
    return refused("create", of_name(dir, name, path), "", ROOM);
}

#define MODE(flags)                                                                                \
    mode_t mode = 0;                                                                               \
    if ((flags) & O_CREAT || ((flags) & O_TMPFILE) == O_TMPFILE) {                                 \
        va_list rest;                                                                              \
        va_start(rest, flags);                                                                     \
        mode = va_arg(rest, mode_t);                                                               \
        va_end(rest);                                                                              \
    }

int openat(int dir, const char *name, int flags, ...)
{
    MODE(flags)
    return opens(dir, name, flags) ? -1 : (int)syscall(SYS_openat, dir, name, flags, mode);
}

int openat64(int dir, const char *name, int flags, ...)
{
    MODE(flags)
    return opens(dir, name, flags) ? -1 : (int)syscall(SYS_openat, dir, name, flags, mode);
}

int open(const char *name, int flags, ...)
{
    MODE(flags)
    return opens(AT_FDCWD, name, flags) ? -1 : (int)syscall(SYS_openat, AT_FDCWD, name, flags, mode);
}

int open64(const char *name, int flags, ...)
{
    MODE(flags)
    return opens(AT_FDCWD, name, flags) ? -1 : (int)syscall(SYS_openat, AT_FDCWD, name, flags, mode);
}

int creat(const char *name, mode_t mode) { return open(name, O_CREAT | O_WRONLY | O_TRUNC, mode); }

int creat64(const char *name, mode_t mode) { return creat(name, mode); }

/* Streams write inside of the C library, where nothing is preloaded: these get one that writes here. */

static ssize_t stream_write(void *cookie, const char *data, size_t size)
{
    size_t done = 0;
    while (done < size) {
        ssize_t now = write((int)(long)cookie, data + done, size - done);
        if (now <= 0)
            return done ? (ssize_t)done : 0;
        done += (size_t)now;
    }
    return (ssize_t)done;
}

static ssize_t stream_read(void *cookie, char *data, size_t size) { return read((int)(long)cookie, data, size); }

static int stream_seek(void *cookie, off64_t *at, int whence)
{
    *at = lseek64((int)(long)cookie, *at, whence);
    return *at < 0 ? -1 : 0;
}

static int stream_close(void *cookie) { return close((int)(long)cookie); }

typedef FILE *(*opener)(const char *, const char *);

static FILE *stream(const char *name, const char *mode)
{
    char path[4096];
    int flags = mode[0] == 'w' ? O_CREAT | O_TRUNC : mode[0] == 'a' ? O_CREAT | O_APPEND : 0;
    flags |= strchr(mode, '+') ? O_RDWR : mode[0] == 'r' ? O_RDONLY : O_WRONLY;
    if (flags == O_RDONLY || !*of_name(AT_FDCWD, name, path))
        return ((opener)dlsym(RTLD_NEXT, "fopen64"))(name, mode);
    int fd = open(name, flags | O_CLOEXEC, 0666);
    if (fd < 0)
        return NULL;
    cookie_io_functions_t functions = {stream_read, stream_write, stream_seek, stream_close};
    FILE *made = fopencookie((void *)(long)fd, mode, functions);
    if (made)
        made->_fileno = fd; /* for who asks for its descriptor, as OpenUSD does */
    return made;
}

FILE *fopen(const char *name, const char *mode) { return stream(name, mode); }

FILE *fopen64(const char *name, const char *mode) { return stream(name, mode); }
