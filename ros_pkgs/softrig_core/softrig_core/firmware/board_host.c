/* The node as a program of this machine: the wire is standard input and output. */
#include "@NODE@_link.h"

#include <stddef.h>
#include <unistd.h>

static @NODE@_link board;
static uint8_t out[4096];
static size_t used;

static void put(uint8_t byte)
{
    out[used++] = byte;
    if (byte == 0u || used == sizeof out) {
        if (write(1, out, used) < 0) {
            _exit(0);
        }
        used = 0;
    }
}

int main(void)
{
    uint8_t in[4096];
    ssize_t n;
    @NODE@_link_init(&board, put, NULL);
    while ((n = read(0, in, sizeof in)) > 0) {
        for (ssize_t i = 0; i < n; i++) {
            @NODE@_link_take(&board, in[i]);
        }
    }
    return 0;
}
