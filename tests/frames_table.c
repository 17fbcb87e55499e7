/* Puts the firmware's frames behind a pipe: "e KIND SEQUENCE PAYLOAD" is answered with the bytes on the wire, "d BYTES"
   with every frame that they hold, as "KIND SEQUENCE PAYLOAD", or "bad", and "."; all in hexadecimal, "-" for none. */
#include <stdio.h>
#include <string.h>

#include "frames.h"

static size_t from_hex(const char *text, uint8_t *bytes)
{
    size_t count = 0;
    unsigned value;
    while (sscanf(text + 2 * count, "%2x", &value) == 1) {
        bytes[count++] = (uint8_t)value;
    }
    return count;
}

static void print_hex(const uint8_t *bytes, size_t count)
{
    for (size_t i = 0; i < count; i++) {
        printf("%02x", (unsigned)bytes[i]);
    }
    printf("%s", count == 0u ? "-" : "");
}

static void decode(const uint8_t *bytes, size_t count)
{
    static frame_reader reader;
    static frame found;
    for (size_t i = 0; i < count; i++) {
        frame_status status = frame_read(&reader, bytes[i], &found);
        if (status == FRAME_GOOD) {
            printf("%02x %04x ", (unsigned)found.kind, (unsigned)found.sequence);
            print_hex(found.payload, found.count);
            printf("\n");
        } else if (status == FRAME_BAD) {
            printf("bad\n");
        }
    }
    printf(".\n");
}

int main(void)
{
    static char line[140000], text[140000];
    static uint8_t bytes[70000];
    while (fgets(line, sizeof line, stdin) != NULL) {
        unsigned kind, sequence;
        if (sscanf(line, "e %x %x %s", &kind, &sequence, text) == 3) {
            uint8_t wire[FRAME_WIRE];
            size_t count = from_hex(text, bytes);
            print_hex(wire, frame_encode((uint8_t)kind, (uint16_t)sequence, bytes, count, wire));
            printf("\n");
        } else if (sscanf(line, "d %s", text) == 1) {
            decode(bytes, from_hex(text, bytes));
        }
    }
    return 0;
}
