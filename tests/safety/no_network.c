/* Loaded before the C library of every program of a test: notes what leaves the machine in the file that
   NETWORK_NOTES names, and lets it fail. Loopback and local sockets work as usual. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static void note(const char *what, const char *where) {
    int file = open(getenv("NETWORK_NOTES"), O_WRONLY | O_APPEND | O_CREAT, 0600);
    char line[512];
    int length = snprintf(line, sizeof line, "%s %s by %s\n", what, where, program_invocation_name);
    if (write(file, line, length) < 0) abort();
    close(file);
}

static int leaves(const char *what, const struct sockaddr *address) {
    char text[INET6_ADDRSTRLEN] = "";
    if (address && address->sa_family == AF_INET) {
        const struct in_addr *to = &((const struct sockaddr_in *)address)->sin_addr;
        if (ntohl(to->s_addr) >> 24 == 127) return 0;
        inet_ntop(AF_INET, to, text, sizeof text);
    } else if (address && address->sa_family == AF_INET6) {
        const struct in6_addr *to = &((const struct sockaddr_in6 *)address)->sin6_addr;
        if (IN6_IS_ADDR_LOOPBACK(to) || (IN6_IS_ADDR_V4MAPPED(to) && to->s6_addr[12] == 127)) return 0;
        inet_ntop(AF_INET6, to, text, sizeof text);
    } else
        return 0;
    note(what, text);
    errno = ENETUNREACH;
    return 1;
}

static int is_looked_up(const char *name) {
    struct in6_addr number;
    if (!name || !strcmp(name, "localhost") || inet_pton(AF_INET, name, &number) == 1 ||
        inet_pton(AF_INET6, name, &number) == 1)
        return 0;
    note("look-up of", name);
    return 1;
}

int connect(int socket, const struct sockaddr *address, socklen_t size) {
    int (*real)(int, const struct sockaddr *, socklen_t) = dlsym(RTLD_NEXT, "connect");
    return leaves("connect to", address) ? -1 : real(socket, address, size);
}

int bind(int socket, const struct sockaddr *address, socklen_t size) {
    int (*real)(int, const struct sockaddr *, socklen_t) = dlsym(RTLD_NEXT, "bind");
    return leaves("bind to", address) ? -1 : real(socket, address, size);
}

ssize_t sendto(int socket, const void *data, size_t count, int flags, const struct sockaddr *address,
               socklen_t size) {
    ssize_t (*real)(int, const void *, size_t, int, const struct sockaddr *, socklen_t) =
        dlsym(RTLD_NEXT, "sendto");
    return leaves("send to", address) ? -1 : real(socket, data, count, flags, address, size);
}

int getaddrinfo(const char *name, const char *service, const struct addrinfo *hints, struct addrinfo **found) {
    int (*real)(const char *, const char *, const struct addrinfo *, struct addrinfo **) =
        dlsym(RTLD_NEXT, "getaddrinfo");
    return is_looked_up(name) ? EAI_FAIL : real(name, service, hints, found);
}

struct hostent *gethostbyname(const char *name) {
    struct hostent *(*real)(const char *) = dlsym(RTLD_NEXT, "gethostbyname");
    return is_looked_up(name) ? NULL : real(name);
}
