/* A search tree of words on the heap: made, walked in order, joined to a string, and freed.
 *
 *     gcc -O0 -o words words.c
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct node {
    char *word;
    int count;
    struct node *left, *right;
} node;

static node *insert(node *tree, const char *word) {
    if (!tree) {
        tree = calloc(1, sizeof *tree);
        tree->word = malloc(strlen(word) + 1);
        strcpy(tree->word, word);
    }
    int order = strcmp(word, tree->word);
    if (order < 0) tree->left = insert(tree->left, word);
    else if (order > 0) tree->right = insert(tree->right, word);
    else tree->count++;
    return tree;
}

static char *append(const node *tree, char *end) {
    if (!tree) return end;
    end = append(tree->left, end);
    for (const char *from = tree->word; *from; from++) *end++ = *from;
    *end++ = '0' + tree->count % 10;
    return append(tree->right, end);
}

static void discard(node *tree) {
    if (!tree) return;
    discard(tree->left);
    discard(tree->right);
    free(tree->word);
    free(tree);
}

int main(void) {
    static char joined[4096];
    node *tree = NULL;
    unsigned seed = 7;
    for (int i = 0; i < 400; i++) {
        char word[8];
        int length = 2;
        for (int k = 0; k < length; k++) {
            seed = seed * 1103515245u + 12345u;
            word[k] = 'a' + (seed >> 16) % 12;
        }
        word[length] = 0;
        tree = insert(tree, word);
    }
    *append(tree, joined) = 0;
    puts(joined);
    discard(tree);
    return 0;
}
