"""Modules of version 0.1 under their old names, for one version, with a ``DeprecationWarning``.

``import pewm_jax`` installs a finder for them. It imports nothing else, so that the package stays
light. A package that was renamed stands for all modules below it: ``training.loop`` is found by the
entry ``training``.
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

MOVED = {
    "atomic": "io.atomic",
    "commands": "cli",
    "commands.compare": "cli.evaluate",
    "commands.demo": "cli.demo",
    "commands.evaluate": "cli.evaluate",
    "commands.horizon": "cli.horizon",
    "commands.imports": "cli.plugins",
    "commands.main": "cli.main",
    "commands.named": "cli.parser",
    "commands.play": "cli.play",
    "commands.practice": "cli.studies",
    "commands.protocol": "cli.evaluate",
    "commands.table1": "cli.studies",
    "commands.table2": "cli.studies",
    "commands.train": "cli.train",
    "config.backbone": "config",
    "config.clip_vision": "config",
    "config.codec": "config",
    "config.codec_world": "config",
    "config.control": "config",
    "config.cosmos": "config",
    "config.dinov2": "config",
    "config.dit": "config",
    "config.egowm": "config",
    "config.egowm_paper": "worlds.egowm.paper",
    "config.encoder": "config",
    "config.errors": "errors",
    "config.frame_blocks": "config",
    "config.frame_flow": "config",
    "config.kinds": "registry",
    "config.learned_codec": "config",
    "config.memory": "config",
    "config.model": "config",
    "config.nomad": "config",
    "config.noise": "config",
    "config.paper": "worlds.pewm.paper",
    "config.persist": "config",
    "config.reader": "config",
    "config.svd_unet": "config",
    "config.svd_vae": "config",
    "config.vae": "config",
    "config.voxel_nets": "config",
    "config.voxel_vae": "config",
    "config.wan_vae": "config",
    "convert.assemble": "convert.pipeline",
    "convert.base": "convert.cogvideox",
    "convert.card": "convert.inference",
    "convert.clip_vision": "models.clip.convert",
    "convert.cosmos_scheduler": "convert.schedulers",
    "convert.cosmos_transformer": "models.cosmos.convert",
    "convert.cosmos_world": "convert.cogvideox_world",
    "convert.diffusers_folder": "convert.cogvideox",
    "convert.dinov2_source": "convert.dinov2",
    "convert.mapping": "io.published",
    "convert.nomad": "models.nomad.convert",
    "convert.scheduler": "convert.schedulers",
    "convert.settings": "io.published",
    "convert.sources": "io.sources",
    "convert.svd_scheduler": "convert.schedulers",
    "convert.svd_unet": "models.svd.convert",
    "convert.svd_vae": "models.svd.convert",
    "convert.svd_world": "convert.cogvideox_world",
    "convert.transformer": "models.cogvideox.convert",
    "convert.vae": "models.cogvideox.convert",
    "convert.wan_vae": "models.wan.convert",
    "convert.whole_world": "convert.pipeline",
    "convert.world": "convert.cogvideox_world",
    "data.bad_records": "data.loader",
    "data.block_pictures": "data.voxel_pictures",
    "data.consistency": "data.checks",
    "data.doors": "data.moving",
    "data.env_episode": "data.collect_env",
    "data.interrupts": "data.engines",
    "data.lighting": "data.shading",
    "data.materials": "data.shading",
    "data.progress": "io.progress",
    "data.recording_folders": "data.recordings",
    "data.surfaces": "data.scenes",
    "data.unfinished": "data.resume",
    "data.voxel_checks": "data.voxels",
    "data.voxel_classes": "data.voxels",
    "data.voxel_frames": "data.voxels",
    "data.voxel_import": "data.recordings",
    "data.voxel_recording": "data.voxelise",
    "diffusion.frame_flow": "diffusion.flow",
    "diffusion.noise": "config.parts",
    "diffusion.schedule": "diffusion.ddpm",
    "diffusion.solver": "diffusion.sampler",
    "evaluation": "eval",
    "evaluation.codec_score": "eval.codec_score",
    "evaluation.compare": "eval.compare",
    "evaluation.compare_page": "report.compare_page",
    "evaluation.covered": "eval.scoring",
    "evaluation.edit_trials": "eval.voxel_trials",
    "evaluation.fixed": "eval.protocol",
    "evaluation.gallery": "eval.gallery",
    "evaluation.horizon": "eval.horizon",
    "evaluation.horizon_page": "eval.horizon",
    "evaluation.images": "eval.metrics.images",
    "evaluation.imagine": "eval.runner",
    "evaluation.intervals": "eval.statistics",
    "evaluation.long_rollouts": "eval.long_rollouts",
    "evaluation.measure": "eval.results",
    "evaluation.methods": "eval.runner",
    "evaluation.metrics": "eval.metrics",
    "evaluation.metrics.chosen": "eval.metrics.selection",
    "evaluation.metrics.distributions": "eval.metrics.videos",
    "evaluation.metrics.dreams": "eval.metrics.perceptual",
    "evaluation.metrics.perceptual": "eval.metrics.perceptual",
    "evaluation.metrics.pictures": "eval.metrics.images",
    "evaluation.metrics.revisits": "eval.metrics.revisits",
    "evaluation.metrics.sam2": "eval.metrics.sam2",
    "evaluation.metrics.similarity": "eval.metrics.revisits",
    "evaluation.metrics.structure": "eval.metrics.structure",
    "evaluation.metrics.videos": "eval.metrics.videos",
    "evaluation.mirror": "eval.mirror",
    "evaluation.opened": "eval.loaded_run",
    "evaluation.page": "report.page",
    "evaluation.page_long": "report.evaluation_page",
    "evaluation.page_tables": "report.evaluation_page",
    "evaluation.partial": "io.store",
    "evaluation.pictures": "report.pictures",
    "evaluation.plots": "report.evaluation_page",
    "evaluation.preview": "eval.preview",
    "evaluation.protocol": "eval.protocol",
    "evaluation.protocol_file": "eval.protocol",
    "evaluation.report": "eval.evaluate",
    "evaluation.reproject": "eval.reproject",
    "evaluation.reproject_choice": "eval.reproject",
    "evaluation.samples": "eval.results",
    "evaluation.scoring": "eval.scoring",
    "evaluation.seen": "eval.metrics.images",
    "evaluation.shares": "io.store",
    "evaluation.statistics": "eval.statistics",
    "evaluation.steering": "eval.steering",
    "evaluation.video": "report.video",
    "evaluation.voxel_score": "eval.voxel_trials",
    "evaluation.words": "report.labels",
    "flags": "cli.flags",
    "geometry.arguments": "geometry.cameras",
    "geometry.camera_steps": "geometry.actions",
    "geometry.holes": "geometry.depth_images",
    "geometry.normals": "geometry.depth_images",
    "geometry.visibility": "geometry.zbuffer",
    "heap": "io.runtime",
    "houses.connectivity": "houses.floorplan",
    "houses.footprints": "houses.floorplan",
    "houses.furniture_parts": "houses.shapes",
    "houses.moving_pieces": "houses.fixtures",
    "houses.room_contents": "houses.furnish",
    "memory.boxes": "memory.cells",
    "memory.class_edit": "memory.class_grid",
    "memory.feature_build": "memory.feature_cache",
    "memory.feature_command": "memory.feature_cache",
    "memory.memories": "memory.interface",
    "memory.nothing": "memory.none",
    "memory.surfel_edit": "memory.surfels",
    "memory.views": "memory.rendering",
    "memory.voxel_cells": "memory.cells",
    "memory.voxel_core": "memory.voxel_map",
    "memory.voxel_edit": "memory.voxel_map",
    "memory.voxel_export": "memory.voxel_files",
    "memory.voxel_memory": "memory.voxel_map",
    "models.action_control": "controls.actions",
    "models.attention_reader": "readers.attention",
    "models.backbones": "models.interface",
    "models.blocked_attention": "nn.attention",
    "models.both_reader": "readers.both",
    "models.camera_control": "controls.camera",
    "models.camera_model": "models.persist.camera_model",
    "models.clip_vision": "models.clip.model",
    "models.codecs": "codecs.rgbd",
    "models.controls": "config.parts",
    "models.convolution": "nn.convolution",
    "models.convolution3d": "nn.convolution",
    "models.cosmos_backbone": "models.cosmos.backbone",
    "models.cosmos_block": "models.cosmos.block",
    "models.costs": "nn.tokens",
    "models.dinov2_encoder": "models.dinov2.encoder",
    "models.dit": "models.cogvideox.model",
    "models.dit_backbone": "models.cogvideox.backbone",
    "models.dit_block": "models.cogvideox.model",
    "models.dreamsim_weights": "models.dreamsim.convert",
    "models.efficientnet": "models.nomad.efficientnet",
    "models.encoders": "config.parts",
    "models.frame_blocks": "models.persist.blocks",
    "models.frame_costs": "planning.planners",
    "models.gates": "codecs.gates",
    "models.i3d_weights": "models.i3d.convert",
    "models.latent_encoder": "encoders.latents",
    "models.layers": "nn.layers",
    "models.learned_codec": "codecs.learned",
    "models.lpips_weights": "models.lpips.convert",
    "models.memory_block": "readers.memory_block",
    "models.memory_geometry": "readers.geometry",
    "models.patch_colours": "encoders.patch_colours",
    "models.patches": "nn.tokens",
    "models.persist_nets": "models.persist.nets",
    "models.pixel_codec": "codecs.pixel",
    "models.placement": "nn.placement",
    "models.plain_layers": "nn.layers",
    "models.positions": "models.cogvideox.positions",
    "models.render_block": "readers.render",
    "models.render_reader": "readers.render",
    "models.signals": "codecs.signals",
    "models.svd_backbone": "models.svd.backbone",
    "models.svd_layers": "models.svd.layers",
    "models.svd_shapes": "models.svd.unet",
    "models.svd_unet": "models.svd.unet",
    "models.svd_vae": "models.svd.vae",
    "models.svd_vae_codec": "models.svd.vae_codec",
    "models.token_layout": "nn.tokens",
    "models.unet1d": "models.nomad.model",
    "models.vae": "models.cogvideox.vae",
    "models.vae_codec": "models.cogvideox.vae_codec",
    "models.vae_convolution": "nn.video_convolution",
    "models.vae_layers": "models.cogvideox.vae_layers",
    "models.vae_shapes": "models.cogvideox.vae_layers",
    "models.vae_tiles": "models.cogvideox.vae",
    "models.voxel_dit": "models.persist.voxel_dit",
    "models.voxel_renderer": "models.persist.voxel_renderer",
    "models.voxel_vae": "models.persist.voxel_vae",
    "models.voxel_vae_shapes": "models.persist.voxel_vae",
    "models.wan_layers": "models.wan.vae",
    "models.wan_vae": "models.wan.vae",
    "models.wan_vae_codec": "models.wan.codec",
    "models.world_model": "worlds.world_model",
    "pickled_tensors": "io.pickles",
    "play.drive_film": "play.saved",
    "play.files_panel": "play.panels",
    "play.kept": "play.saved",
    "play.requests": "play.session",
    "play.status": "play.panels",
    "play.ticking": "play.driver",
    "play.visitors": "play.serving",
    "rollouts": "worlds.rollouts",
    "scaling": "plan",
    "planning.floor_map": "planning.practice",
    "planning.ranking": "planning.candidates",
    "planning.rounds_file": "planning.plan",
    "planning.tasks": "planning.house",
    "scaling.footprint": "plan.suggest",
    "scaling.hlo": "plan.hlo",
    "scaling.hlo_text": "plan.hlo",
    "scaling.plan": "plan.plan",
    "scaling.plan_text": "plan.plan",
    "scaling.predict": "plan.suggest",
    "scaling.stage_plan": "planning.plan",
    "scaling.suggest": "plan.suggest",
    "studies.kept": "io.store",
    "studies.policies": "studies.deciders",
    "studies.practice_page": "studies.practice",
    "studies.recorded": "studies.table1_scoring",
    "studies.rows": "studies.table1_rows",
    "studies.scorer": "studies.table1_scoring",
    "studies.table": "studies.table1",
    "studies.table_cells": "studies.table1_page",
    "studies.table_formats": "report.table",
    "studies.table_page": "studies.table1_page",
    "studies.timing": "studies.table1_training",
    "studies.trainings": "studies.table1_training",
    "tensor_files": "io.tensor_files",
    "training": "train",
    "training.background": "train.checkpoint",
    "training.checkpoint": "train.checkpoint",
    "training.chips": "train.chips",
    "training.feed": "train.feed",
    "training.integrity": "train.checkpoint_files",
    "training.loading": "train.loading",
    "training.log": "train.log",
    "training.loop": "train.loop",
    "training.optimizer": "train.optimizer",
    "training.prepared": "train.feed",
    "training.processes": "train.processes",
    "training.profile": "train.log",
    "training.runs": "train.runs",
    "training.samples": "train.watch",
    "training.sharding": "train.sharding",
    "training.signals": "train.signals",
    "training.stages": "train.stages",
    "training.starting": "train.loading",
    "training.state": "train.step",
    "training.step": "train.step",
    "training.step_folders": "train.checkpoint_files",
    "training.wandb_log": "train.log",
    "training.watch": "train.watch",
    "tree": "io.tree",
    "weights": "io.weights",
    "worlds.chained": "worlds.objective",
    "worlds.chunks": "worlds.control",
    "worlds.codec_gate": "worlds.codec",
    "worlds.costs": "train.flops",
    "worlds.persist_classes": "worlds.persist.losses",
    "worlds.persist_losses": "worlds.persist.losses",
    "worlds.persist_past": "worlds.persist.state",
    "worlds.persist_pictures": "worlds.persist.step",
    "worlds.persist_prepare": "worlds.persist.prepare",
    "worlds.persist_sight": "worlds.persist.voxel_frames",
    "worlds.persist_stages": "worlds.persist.stages",
    "worlds.persist_step": "worlds.persist.step",
    "worlds.persist_voxels": "worlds.persist.voxel_frames",
    "worlds.persist_windows": "worlds.persist.state",
    "worlds.pewm_costs": "train.flops",
    "worlds.pewm_gate": "worlds.pewm.gate",
    "worlds.pewm_many": "worlds.pewm.candidates",
    "worlds.pewm_views": "worlds.pewm.candidates",
    "worlds.sampling": "worlds.world_model",
}
"""Old module → new module, both without ``pewm_jax.``"""


def new_name(name: str) -> str | None:
    """Return the present name of a module that was renamed, else None.

    Args:
        name: its old name, with the package's.
    """
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
