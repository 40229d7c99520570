"""Temporary: replaced by the table of stage 1."""
from __future__ import annotations
from dataclasses import dataclass
import numpy as np
from jaxnew.actions import content_hash
@dataclass(frozen=True)
class RepresentationTable:
    vectors: np.ndarray
    ids: np.ndarray
    universe_hash: str|None
    split_hash: str|None
    source: str
    @property
    def hash(self): return content_hash(np.asarray(self.vectors), np.asarray(self.ids))
    def rows(self, ids): return self.vectors[np.searchsorted(self.ids, ids)]
    def save(self, path): np.savez(path, vectors=self.vectors, ids=self.ids)
    @classmethod
    def load(cls, path): raise NotImplementedError
    def check(self, universe, split): pass
def engineered_table(universe, name):
    return RepresentationTable(universe.engineered[name], np.arange(universe.num_actions,dtype=np.int32), universe.hash, None, name)
