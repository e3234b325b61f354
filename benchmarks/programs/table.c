/* An open-addressing hash table of words of a generator, then a heap sort of its counts.
 *
 *     gcc -O2 -o table table.c
 */
#include <stdint.h>
#include <stdio.h>

#define SLOTS 1024
static uint32_t keys[SLOTS], counts[SLOTS];

static void sift(uint32_t *a, int i, int n) {
    for (int child; (child = 2 * i + 1) < n; i = child) {
        if (child + 1 < n && a[child + 1] > a[child]) child++;
        if (a[i] >= a[child]) return;
        uint32_t kept = a[i];
        a[i] = a[child];
        a[child] = kept;
    }
}

int main(void) {
    uint32_t word = 12345;
    for (int i = 0; i < 12000; i++) {
        word = word * 1664525u + 1013904223u;
        uint32_t key = (word >> 16) % 700 + 1, slot = key * 2654435761u % SLOTS;
        while (keys[slot] && keys[slot] != key) slot = (slot + 1) % SLOTS;
        keys[slot] = key;
        counts[slot] += word & 15;
    }
    for (int i = SLOTS / 2; i >= 0; i--) sift(counts, i, SLOTS);
    for (int n = SLOTS - 1; n > 0; n--) {
        uint32_t kept = counts[0];
        counts[0] = counts[n];
        counts[n] = kept;
        sift(counts, 0, n);
    }
    uint32_t sum = 0;
    for (int i = 0; i < SLOTS; i++) sum = sum * 31 + counts[i] + keys[i];
    for (int i = SLOTS - 8; i < SLOTS; i++) printf("%u ", counts[i]);
    printf("%08x\n", sum);
    return 0;
}
