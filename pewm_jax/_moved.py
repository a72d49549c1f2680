"""Modules of version 0.1 under their old names, for one version, with a ``DeprecationWarning``.

``import pewm_jax`` installs a finder for them and imports nothing else. The former name of a
package holds for all modules below it: ``training`` maps ``training.loop`` to ``train.loop``.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

PACKAGE = "pewm_jax."

FORMER = {
    "cli": ("commands",),
    "cli.evaluate": ("commands.compare", "commands.protocol"),
    "cli.parser": ("commands.named", "flags"),
    "cli.plugins": ("commands.imports",),
    "cli.studies": ("commands.practice", "commands.table1", "commands.table2"),
    "codecs.gates": ("models.gates",),
    "codecs.learned": ("models.learned_codec",),
    "codecs.pixel": ("models.pixel_codec",),
    "codecs.rgbd": ("models.codecs",),
    "codecs.signals": ("models.signals",),
    "config": (
        "config.backbone",
        "config.clip_vision",
        "config.codec",
        "config.codec_world",
        "config.control",
        "config.cosmos",
        "config.dinov2",
        "config.dit",
        "config.egowm",
        "config.encoder",
        "config.frame_blocks",
        "config.frame_flow",
        "config.learned_codec",
        "config.memory",
        "config.model",
        "config.noise",
        "config.nomad",
        "config.persist",
        "config.reader",
        "config.svd_unet",
        "config.svd_vae",
        "config.vae",
        "config.voxel_nets",
        "config.voxel_vae",
        "config.wan_vae",
    ),
    "config.parts": ("diffusion.noise", "models.controls", "models.encoders"),
    "config.training": ("config.mesh",),
    "config.world": ("config.clip",),
    "controls.actions": ("models.action_control",),
    "controls.camera": ("models.camera_control",),
    "convert.cogvideox": ("convert.base", "convert.diffusers_folder", "convert.world"),
    "convert.cosmos": ("convert.cosmos_world",),
    "convert.dinov2": ("convert.dinov2_source",),
    "convert.inference": ("convert.card",),
    "convert.pipeline": ("convert.assemble", "convert.whole_world"),
    "convert.schedulers": (
        "convert.cosmos_scheduler",
        "convert.scheduler",
        "convert.svd_scheduler",
    ),
    "convert.svd": ("convert.svd_world",),
    "data.checks": ("data.consistency",),
    "data.collect": ("data.interrupts",),
    "data.collect_env": ("data.env_episode",),
    "data.loader": ("data.bad_records",),
    "data.moving": ("data.doors",),
    "data.recordings": ("data.recording_folders", "data.voxel_import"),
    "data.render": ("data.block_pictures",),
    "data.resume": ("data.unfinished",),
    "data.scenes": ("data.surfaces",),
    "data.shading": ("data.lighting", "data.materials"),
    "data.voxelise": ("data.voxel_recording",),
    "data.voxels": ("data.voxel_checks", "data.voxel_classes", "data.voxel_frames"),
    "diffusion.ddpm": ("diffusion.sampler", "diffusion.schedule", "diffusion.solver"),
    "diffusion.flow": ("diffusion.frame_flow",),
    "encoders.simple": ("models.latent_encoder", "models.patch_colours"),
    "errors": ("config.errors",),
    "eval": ("evaluation",),
    "eval.evaluate": ("evaluation.report",),
    "eval.horizon": ("evaluation.horizon_page",),
    "eval.loaded_run": ("evaluation.opened",),
    "eval.metrics.images": ("evaluation.images", "evaluation.metrics.pictures", "evaluation.seen"),
    "eval.metrics.perceptual": ("evaluation.metrics.dreams",),
    "eval.metrics.revisits": ("evaluation.metrics.similarity",),
    "eval.metrics.selection": ("evaluation.metrics.chosen",),
    "eval.metrics.videos": ("evaluation.metrics.distributions",),
    "eval.protocol": ("evaluation.fixed", "evaluation.protocol_file"),
    "eval.reproject": ("evaluation.reproject_choice",),
    "eval.results": ("evaluation.measure", "evaluation.samples"),
    "eval.runner": ("evaluation.imagine", "evaluation.methods"),
    "eval.scoring": ("evaluation.covered",),
    "eval.statistics": ("evaluation.intervals",),
    "eval.voxel_trials": ("evaluation.edit_trials", "evaluation.voxel_score"),
    "geometry.actions": ("geometry.camera_steps",),
    "geometry.cameras": ("geometry.arguments",),
    "geometry.depth_images": ("geometry.holes", "geometry.normals"),
    "geometry.zbuffer": ("geometry.visibility",),
    "houses.fixtures": ("houses.moving_pieces",),
    "houses.floorplan": ("houses.connectivity", "houses.footprints"),
    "houses.furnish": ("houses.room_contents",),
    "houses.shapes": ("houses.furniture_parts",),
    "io.atomic": ("atomic",),
    "io.pickles": ("pickled_tensors",),
    "io.progress": ("data.progress",),
    "io.published": ("convert.mapping", "convert.settings"),
    "io.runtime": ("heap",),
    "io.sources": ("convert.sources",),
    "io.store": ("evaluation.partial", "evaluation.shares", "studies.kept"),
    "io.tensor_files": ("tensor_files",),
    "io.tree": ("tree",),
    "io.weights": ("weights",),
    "memory.cells": ("memory.boxes", "memory.voxel_cells"),
    "memory.class_grid": ("memory.class_edit",),
    "memory.feature_cache": ("memory.feature_build", "memory.feature_command"),
    "memory.interface": ("memory.memories",),
    "memory.none": ("memory.nothing",),
    "memory.rendering": ("memory.views",),
    "memory.surfels": ("memory.surfel_edit",),
    "memory.voxel_files": ("memory.voxel_export",),
    "memory.voxel_map": (
        "memory.map2d",
        "memory.voxel_core",
        "memory.voxel_edit",
        "memory.voxel_memory",
    ),
    "models.clip.convert": ("convert.clip_vision",),
    "models.clip.model": ("models.clip_vision",),
    "models.cogvideox.backbone": ("models.dit_backbone",),
    "models.cogvideox.convert": ("convert.transformer", "convert.vae"),
    "models.cogvideox.model": ("models.dit", "models.dit_block"),
    "models.cogvideox.positions": ("models.positions",),
    "models.cogvideox.vae": ("models.vae", "models.vae_codec", "models.vae_tiles"),
    "models.cogvideox.vae_layers": ("models.vae_layers", "models.vae_shapes"),
    "models.cosmos.backbone": ("models.cosmos_backbone",),
    "models.cosmos.convert": ("convert.cosmos_transformer",),
    "models.cosmos.model": ("models.cosmos_block",),
    "models.dinov2.model": ("models.dinov2_encoder",),
    "models.dreamsim.convert": ("models.dreamsim_weights",),
    "models.i3d.convert": ("models.i3d_weights",),
    "models.interface": ("models.backbones",),
    "models.lpips.convert": ("models.lpips_weights",),
    "models.nomad.convert": ("convert.nomad",),
    "models.nomad.efficientnet": ("models.efficientnet",),
    "models.nomad.model": ("models.unet1d",),
    "models.persist.blocks": ("models.frame_blocks",),
    "models.persist.camera_model": ("models.camera_model",),
    "models.persist.nets": ("models.persist_nets",),
    "models.persist.voxel_dit": ("models.voxel_dit",),
    "models.persist.voxel_renderer": ("models.voxel_renderer",),
    "models.persist.voxel_vae": ("models.voxel_vae", "models.voxel_vae_shapes"),
    "models.svd.convert": ("convert.svd_unet", "convert.svd_vae"),
    "models.svd.layers": ("models.svd_layers",),
    "models.svd.unet": ("models.svd_backbone", "models.svd_shapes", "models.svd_unet"),
    "models.svd.vae": ("models.svd_vae", "models.svd_vae_codec"),
    "models.wan.convert": ("convert.wan_vae",),
    "models.wan.vae": ("models.wan_layers", "models.wan_vae", "models.wan_vae_codec"),
    "nn.attention": ("models.blocked_attention",),
    "nn.convolution": ("models.convolution", "models.convolution3d"),
    "nn.layers": ("models.layers", "models.plain_layers"),
    "nn.placement": ("models.placement",),
    "nn.tokens": ("models.costs", "models.patches", "models.token_layout"),
    "nn.video_convolution": ("models.vae_convolution",),
    "plan": ("scaling",),
    "plan.hlo": ("scaling.hlo_text",),
    "plan.plan": ("scaling.plan_text", "scaling.stage_plan"),
    "plan.program": ("scaling.hlo",),
    "plan.suggest": ("scaling.footprint", "scaling.predict"),
    "planning.candidates": ("planning.ranking",),
    "planning.house": ("planning.tasks",),
    "planning.plan": ("planning.rounds_file",),
    "planning.planners": ("models.frame_costs",),
    "planning.practice": ("planning.floor_map",),
    "play.driver": ("play.ticking",),
    "play.page": ("play.files_panel", "play.status"),
    "play.saved": ("play.drive_film", "play.kept"),
    "play.serving": ("play.visitors",),
    "play.session": ("play.requests",),
    "readers.attention": ("models.attention_reader",),
    "readers.geometry": ("models.memory_geometry",),
    "readers.memory_block": ("models.memory_block",),
    "readers.render": ("models.both_reader", "models.render_block", "models.render_reader"),
    "registry": ("config.kinds",),
    "report.compare_page": ("evaluation.compare_page",),
    "report.evaluation_page": (
        "evaluation.page_long",
        "evaluation.page_tables",
        "evaluation.plots",
    ),
    "report.labels": ("evaluation.words",),
    "report.page": ("evaluation.page",),
    "report.pictures": ("evaluation.pictures",),
    "report.table": ("studies.table_formats",),
    "report.video": ("evaluation.video",),
    "studies.deciders": ("studies.policies",),
    "studies.practice": ("studies.practice_page",),
    "studies.table1": ("studies.table",),
    "studies.table1_page": ("studies.table_cells", "studies.table_page"),
    "studies.table1_rows": ("studies.rows",),
    "studies.table1_scoring": ("studies.recorded", "studies.scorer"),
    "studies.table1_training": ("studies.timing", "studies.trainings"),
    "train": ("training",),
    "train.checkpoint": ("training.background",),
    "train.checkpoint_files": ("training.integrity", "training.step_folders"),
    "train.feed": ("training.prepared",),
    "train.flops": ("worlds.costs", "worlds.pewm_costs"),
    "train.loading": ("training.starting",),
    "train.log": ("training.profile",),
    "train.runs": ("training.stages",),
    "train.sinks": ("training.wandb_log",),
    "train.step": ("training.state",),
    "train.watch": ("training.samples",),
    "worlds.codec": ("worlds.codec_gate",),
    "worlds.control": ("worlds.chunks",),
    "worlds.egowm.paper": ("config.egowm_paper",),
    "worlds.objective": ("worlds.chained",),
    "worlds.persist.prepare": ("worlds.persist_prepare",),
    "worlds.persist.stages": (
        "worlds.persist_classes",
        "worlds.persist_losses",
        "worlds.persist_stages",
    ),
    "worlds.persist.state": ("worlds.persist_past", "worlds.persist_windows"),
    "worlds.persist.step": ("worlds.persist_pictures", "worlds.persist_step"),
    "worlds.persist.voxel_frames": ("worlds.persist_sight", "worlds.persist_voxels"),
    "worlds.pewm.candidates": ("worlds.pewm_many", "worlds.pewm_views"),
    "worlds.pewm.paper": ("config.paper",),
    "worlds.pewm.world": ("worlds.pewm_gate",),
    "worlds.rollouts": ("rollouts",),
    "worlds.world_model": ("models.world_model", "worlds.sampling"),
}
"""New module → its former names, all without ``pewm_jax.``"""
MOVED = {old: new for new, names in FORMER.items() for old in names}
"""Old module → new module."""


def new_name(name: str) -> str | None:
    """Return the present full name of a module by its former full name; None if it has none."""
    if not name.startswith(PACKAGE):
        return None
    head, tail = name.removeprefix(PACKAGE), ""
    while head:
        if head in MOVED:
            return PACKAGE + MOVED[head] + tail
        head, _, last = head.rpartition(".")
        tail = f".{last}{tail}"
    return None


class _Alias(Loader):
    """Loads a module as another one, which keeps its own name and specification."""

    def __init__(self, name: str):
        """Alias of the module with this name."""
        self.name = name

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the module itself."""
        del spec
        module = importlib.import_module(self.name)
        self.spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Undo what the import system changes; the module was run when it was imported."""
        module.__spec__ = self.spec


class _Finder(MetaPathFinder):
    """Finds modules by the names that they had."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to load a module that was renamed, with a warning; None for all others."""
        del path, target
        name = new_name(fullname)
        if name is None:
            return None
        warnings.warn(
            f"The module {fullname} is now {name}; the old name goes in the next version.",
            DeprecationWarning,
            stacklevel=2,
        )
        return ModuleSpec(fullname, _Alias(name))


def install() -> None:
    """Let the old names be imported."""
    # First, because in an alias of a package the usual finder would load a module a second time.
    if not any(type(finder).__name__ == _Finder.__name__ for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
