/* Preloaded into a process, it loses datagrams, in and out alike: the share that LOSS says. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/types.h>
#include <sys/uio.h>

static double loss;

__attribute__((constructor)) static void read_loss(void) {
  const char *text = getenv("LOSS");
  loss = text ? atof(text) : 0.0;
}

static int lost(int socket) {
  int kind = 0;
  socklen_t size = sizeof kind;
  if (getsockopt(socket, SOL_SOCKET, SO_TYPE, &kind, &size) || kind != SOCK_DGRAM) return 0;
  static __thread unsigned seed = 12345;
  return rand_r(&seed) < loss * RAND_MAX;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t sendto(int to, const void *data, size_t size, int flags, const struct sockaddr *where,
               socklen_t length) {
  return lost(to) ? (ssize_t)size : REAL(sendto)(to, data, size, flags, where, length);
}

ssize_t sendmsg(int to, const struct msghdr *message, int flags) {
  if (!lost(to)) return REAL(sendmsg)(to, message, flags);
  ssize_t size = 0;
  for (size_t i = 0; i < message->msg_iovlen; i++) size += message->msg_iov[i].iov_len;
  return size;
}

ssize_t recvfrom(int from, void *restrict data, size_t size, int flags,
                 struct sockaddr *restrict where, socklen_t *restrict length) {
  for (;;) {
    ssize_t got = REAL(recvfrom)(from, data, size, flags, where, length);
    if (got < 0 || !lost(from)) return got;
  }
}

ssize_t recvmsg(int from, struct msghdr *message, int flags) {
  for (;;) {
    ssize_t got = REAL(recvmsg)(from, message, flags);
    if (got < 0 || !lost(from)) return got;
  }
}
