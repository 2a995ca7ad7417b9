/* The link of a board to softrig: frames of COBS(number, kind, values, CRC) and a zero. C99, no dynamic memory.
 *
 * The number of a request is in its answer. A request with the number of the one before gets the same answer without
 * another step; one with an older number gets none. The CRC begins with the number of the session, which a hello
 * chooses: frames of another session, or of a board that has restarted since, do not pass it.
 *
 * Include once, after defining SR_LINK_ROOM: bytes of the longest frame before its zero.
 */
#ifndef SOFTRIG_LINK_H
#define SOFTRIG_LINK_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

enum { SR_HELLO = 1, SR_RESET = 2, SR_PARAMS = 3, SR_STEP = 4, SR_ANSWER = 5 };
enum { SR_NOT_RESET = 2, SR_BAD_LENGTH = 3, SR_BAD_KIND = 4 }; /* further statuses beside SR_DONE and SR_GAVE_UP */
#define SR_HEAD 3u /* bytes of number and kind */
#define SR_GREETING 64u
#define SR_NEWER 0x8000u

typedef struct sr_link {
    uint8_t in[SR_LINK_ROOM];
    uint8_t out[SR_LINK_ROOM];        /**< the newest answer, which is sent again where it got lost */
    uint8_t greeting[SR_GREETING];    /**< the answer to a hello */
    uint16_t length;      /**< bytes in `in` */
    uint16_t answered;    /**< bytes in `out`, without the CRC; 0: no answer yet */
    uint16_t session;     /**< 0: none */
    uint16_t newest;      /**< number of the newest request */
    uint16_t offered;     /**< session of the newest hello: it begins with the first frame that passes its checksum */
    uint16_t hello;       /**< number of that hello */
    uint8_t code, left;   /**< of COBS: length of the block, and bytes of it that are to come */
    bool lost, reset;     /**< more bytes than a frame has; whether steps may be answered */
    void (*put)(uint8_t); /**< sends a byte */
} sr_link;

#ifdef SR_LINK_SOURCE /* the file that answers */

static uint16_t sr_crc_byte(uint16_t crc, uint8_t byte)
{
    crc ^= (uint16_t)((uint16_t)byte << 8);
    for (uint8_t i = 0; i < 8u; i++) {
        crc = (crc & 0x8000u) ? (uint16_t)((crc << 1) ^ 0x1021u) : (uint16_t)(crc << 1);
    }
    return crc;
}

static uint16_t sr_crc(uint16_t session, const uint8_t *data, uint16_t length)
{
    uint16_t crc = sr_crc_byte(sr_crc_byte(0, (uint8_t)(session & 0xFFu)), (uint8_t)(session >> 8));
    for (uint16_t i = 0; i < length; i++) {
        crc = sr_crc_byte(crc, data[i]);
    }
    return crc;
}

static uint16_t sr_word(const uint8_t *at)
{
    return (uint16_t)(at[0] | ((uint16_t)at[1] << 8));
}

/* Send `length` bytes and their CRC, for which there is room behind them. */
static void sr_send(const sr_link *link, uint8_t *out, uint16_t session, uint16_t length)
{
    const uint16_t crc = sr_crc(session, out, length);
    uint16_t at = 0;
    out[length] = (uint8_t)(crc & 0xFFu);
    out[length + 1u] = (uint8_t)(crc >> 8);
    length += 2u;
    for (;;) { /* a block is the bytes up to the next zero, 254 at most */
        uint16_t end = at;
        while (end < length && out[end] != 0u && (uint16_t)(end - at) < 254u) {
            end++;
        }
        link->put((uint8_t)(end - at + 1u));
        for (uint16_t i = at; i < end; i++) {
            link->put(out[i]);
        }
        if (end == length) {
            break;
        }
        at = ((uint16_t)(end - at) == 254u) ? end : (uint16_t)(end + 1u); /* a full block stands for no zero */
    }
    link->put(0);
}

/* Take a byte of the wire; true: `in` has the bytes of a frame, `length` of them. */
static bool sr_frame(sr_link *link, uint8_t byte)
{
    if (byte == 0u) {
        const bool whole = !link->lost && link->left == 0u && link->length >= SR_HEAD + 2u;
        const uint16_t length = link->length;
        link->code = 0xFFu;
        link->left = 0;
        link->lost = false;
        link->length = whole ? length : 0u;
        return whole;
    }
    if (link->left == 0u) {
        if (link->code != 0xFFu) {
            if (link->length < SR_LINK_ROOM) {
                link->in[link->length++] = 0;
            } else {
                link->lost = true;
            }
        }
        link->code = byte;
        link->left = (uint8_t)(byte - 1u);
    } else {
        link->left--;
        if (link->length < SR_LINK_ROOM) {
            link->in[link->length++] = byte;
        } else {
            link->lost = true;
        }
    }
    return false;
}

/* Take a byte of the wire. Returns the kind of a request that is to be answered now, 0 for none; its values are the
 * `length` bytes from `in` + SR_HEAD on. What was answered before is answered again here.
 */
static uint8_t sr_request(sr_link *link, uint8_t byte)
{
    uint16_t ahead, number, size;
    if (!sr_frame(link, byte)) {
        return 0;
    }
    size = (uint16_t)(link->length - 2u);
    link->length = 0;
    number = sr_word(link->in);
    if (link->in[2] == SR_HELLO && size == SR_HEAD + 2u && sr_word(link->in + size) == sr_crc(0, link->in, size)) {
        link->offered = sr_word(link->in + SR_HEAD);
        link->hello = number;
        link->length = 2;
        return SR_HELLO;
    }
    if (link->session == 0u || sr_word(link->in + size) != sr_crc(link->session, link->in, size)) {
        if (link->offered == 0u || sr_word(link->in + size) != sr_crc(link->offered, link->in, size)) {
            return 0;
        }
        if (link->offered != link->session) { /* a hello that was delayed ends no session: no frame follows it */
            link->session = link->offered;
            link->newest = link->hello;
            link->answered = 0;
            link->reset = false;
        }
        link->offered = 0;
    }
    ahead = (uint16_t)(number - link->newest);
    if (ahead == 0u && link->answered != 0u) {
        sr_send(link, link->out, link->session, link->answered);
        return 0;
    }
    if (ahead == 0u || ahead >= SR_NEWER) {
        return 0;
    }
    link->newest = number;
    link->length = (uint16_t)(size - SR_HEAD);
    return link->in[2];
}

/* Where the values of an answer go. */
static uint8_t *sr_values(sr_link *link, uint8_t kind)
{
    return ((kind == SR_HELLO) ? link->greeting : link->out) + SR_HEAD + 1;
}

/* Answer with the `size` bytes of values that are there. */
static void sr_answer(sr_link *link, uint8_t kind, uint8_t status, uint16_t size)
{
    const uint16_t length = (uint16_t)(SR_HEAD + 1u + size);
    uint8_t *const out = (kind == SR_HELLO) ? link->greeting : link->out;
    link->length = 0;
    out[0] = link->in[0];
    out[1] = link->in[1];
    out[2] = (kind == SR_HELLO) ? SR_HELLO : SR_ANSWER;
    out[3] = status;
    if (kind == SR_HELLO) {
        sr_send(link, out, 0, length);
    } else {
        link->answered = length;
        sr_send(link, out, link->session, length);
    }
}

/* Read and write numbers as they lie in memory: these boards are little-endian, as the wire. */
static const uint8_t *sr_read(const uint8_t *from, void *to, uint16_t size)
{
    memcpy(to, from, size);
    return from + size;
}

static uint8_t *sr_write(uint8_t *to, const void *from, uint16_t size)
{
    memcpy(to, from, size);
    return to + size;
}

#endif /* SR_LINK_SOURCE */

#endif
